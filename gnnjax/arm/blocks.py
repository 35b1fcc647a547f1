"""Covers of boxes and cylinders in closed form: spheres in the cells of a grid.

They are worse than fitted ones (`fit.py`) by some millimetres, and there in no time.
"""

import itertools

import numpy as np

from gnnjax.arm.fit import Cover

_MOST = 12  # spheres
_SLACK = 1e-6  # m; for rounding


def box_cover(half_extents: np.ndarray, enough: float) -> Cover:
    """Spheres around a box, about its centre and along its axes.

    Args:
        half_extents: `[3]` m.
        enough: overshoot beyond which no more spheres are taken, m.
    """

    def depths(centers: np.ndarray) -> np.ndarray:
        return (half_extents - np.abs(centers)).min(axis=1)

    choices = [
        (centers, float(np.linalg.norm(cell)), depths(centers))
        for cell, centers in _grids(half_extents)
    ]
    return _best(choices, enough)


def cylinder_cover(radius: float, half_length: float, around: float, enough: float) -> Cover:
    """Spheres around a cylinder, about its centre and along its z axis.

    Args:
        radius: m.
        half_length: m.
        around: radius of what is to be enclosed, a polytope around the cylinder, m.
        enough: overshoot beyond which no more spheres are taken, m.
    """
    choices = []
    for cell, centers in _grids(np.array([around, around, half_length])):
        beside = np.linalg.norm(centers[:, :2], axis=1)
        depths = np.minimum(radius - beside, half_length - np.abs(centers[:, 2]))
        # A single column has a disc to enclose, and not the square around it.
        on_axis = not beside.any()
        size = np.hypot(around, cell[2]) if on_axis else np.linalg.norm(cell)
        choices.append((centers, float(size), depths))
    return _best(choices, enough)


def _grids(half_extents: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Half extents `[3]` of cells, and their centers `[S 3]`, of all grids of few cells."""
    found = []
    for counts in itertools.product(range(1, _MOST + 1), repeat=3):
        if np.prod(counts) <= _MOST:
            cell = half_extents / np.array(counts)
            places = [
                (2 * np.arange(n) + 1 - n) * size for n, size in zip(counts, cell, strict=True)
            ]
            centers = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, 3)
            found.append((cell, centers))
    return found


def _best(choices: list[tuple[np.ndarray, float, np.ndarray]], enough: float) -> Cover:
    """Of centers, their radius and depths: what reaches out least, or enough with fewest."""

    def rank(choice: tuple[np.ndarray, float, np.ndarray]) -> tuple[float, int, float]:
        centers, radius, depths = choice
        overshoot = radius - float(depths.min())
        return max(overshoot, enough), len(centers), overshoot

    centers, radius, depths = min(choices, key=rank)
    return Cover(centers, np.full(len(centers), radius + _SLACK), depths - _SLACK)
