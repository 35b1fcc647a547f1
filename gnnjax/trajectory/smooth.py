"""How far the corners of certified paths can be rounded."""

from typing import NamedTuple

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import certify_edges
from gnnjax.scene.scene import Scene
from gnnjax.trajectory.curve import blend_chords, distinct, edges_of

_CHORDS = 6  # of a blend, to be certified; even
# Of an edge, that a blend takes at most. Two halves would leave nothing between them, or what
# rounding made of equal edges, so short that its push is rounding, too: 0.2 % above the limits.
_HALF = 0.4999
_HALVINGS = 6  # of a blend that is not certified, before the motion stops at its corner


class Smoothed(NamedTuple):
    """A path of L configurations whose corners are rounded."""

    path: np.ndarray  # [L D] rad or m, double precision, without repetitions
    blends: np.ndarray  # [L - 2] before and behind each corner, configuration units; 0: stop
    certified: bool  # the whole curve is proven free of collisions; without, all blends are 0


def smooth_paths(
    robot: Robot, scene: Scene, paths: list[np.ndarray], blend: float, *, proven: bool = False
) -> list[Smoothed]:
    """Rounds the corners of P paths as far as is certified, all along the curves.

    Each blend begins as `blend`, at most nearly half of the shorter of its edges. Where that is not
    certified it is halved, and given up in the end.

    Args:
        robot: the arm.
        scene: one scene, or P scenes `[P, M, ...]`, one a path.
        paths: each `[L, D]`, one configuration or more.
        blend: length of an edge that a blend takes at most, configuration units.
        proven: the paths themselves are certified already, and only blends are left to be.
    """
    several = np.ndim(scene.mask) == 2
    paths = [distinct(path) for path in paths]
    free = np.ones(len(paths), bool) if proven else _certified(robot, scene, paths)

    blends = []
    for path, good in zip(paths, free, strict=True):
        half = _HALF * edges_of(path)[0]
        most = np.minimum(np.minimum(half[:-1], half[1:]), blend)
        blends.append(most if good else np.zeros_like(most))
    owner = np.repeat(np.arange(len(paths)), [len(x) for x in blends])
    corner = np.concatenate([np.arange(len(x)) for x in blends])
    width = np.concatenate(blends)
    open_ones = np.flatnonzero(width > 0)
    for halving in range(_HALVINGS + 1):
        chords = [
            blend_chords(paths[p], corner[rows] + 1, width[rows], _CHORDS)
            for p in np.unique(owner[open_ones])
            for rows in [open_ones[owner[open_ones] == p]]
        ]
        if not chords:
            break
        points, slack = (np.concatenate(x) for x in zip(*chords, strict=True))
        starts, ends, slack = (
            x.reshape(-1, robot.num_dof) for x in (points[:, :-1], points[:, 1:], slack)
        )
        belongs = np.repeat(owner[open_ones], _CHORDS) if several else None
        clear = certify_edges(robot, scene, starts, ends, belongs, slack)
        open_ones = open_ones[~clear.reshape(-1, _CHORDS).all(axis=1)]
        width[open_ones] *= 0.0 if halving == _HALVINGS else 0.5
    blends = np.split(width, np.cumsum([len(x) for x in blends])[:-1])
    return [Smoothed(*each) for each in zip(paths, blends, free.tolist(), strict=True)]


def _certified(robot: Robot, scene: Scene, paths: list[np.ndarray]) -> np.ndarray:
    """Which of P paths are certified as they are, `[P]`."""
    # A single configuration is its own end.
    paths = [np.concatenate([path, path]) if len(path) == 1 else path for path in paths]
    owner = np.repeat(np.arange(len(paths)), [len(path) - 1 for path in paths])
    starts = np.concatenate([path[:-1] for path in paths])
    ends = np.concatenate([path[1:] for path in paths])
    free = np.ones(len(paths), bool)
    proven = certify_edges(robot, scene, starts, ends, owner if np.ndim(scene.mask) == 2 else None)
    np.logical_and.at(free, owner, proven)
    return free
