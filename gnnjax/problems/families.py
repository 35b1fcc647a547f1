"""Families of scenes that are hard on purpose: shelf, table, window, clutter, bin, cans, pipes,
a shelf as a depth camera sees it, and one for a bottle that is held upright.

A family draws a scene and the two regions in which the arm's tip starts and ends, see
`structures.py`.
"""

from typing import Literal, TypeAlias

from gnnjax.problems.clutter import draw_clutter, draw_pipes
from gnnjax.problems.furniture import draw_bin, draw_table, draw_window
from gnnjax.problems.shelves import draw_cans, draw_cloud_shelf, draw_shelf, draw_upright

FamilyName: TypeAlias = Literal[
    "shelf", "table", "window", "clutter", "bin", "cans", "pipes", "cloud_shelf", "upright"
]

FAMILIES = {
    "shelf": draw_shelf,
    "table": draw_table,
    "window": draw_window,
    "clutter": draw_clutter,
    "bin": draw_bin,
    # Problems are drawn by the number of their family: others go to the end.
    "cans": draw_cans,
    "pipes": draw_pipes,
    "cloud_shelf": draw_cloud_shelf,
    "upright": draw_upright,
}
BOX_FAMILIES = ("shelf", "table", "window", "clutter", "bin")  # what the motion network learns from
