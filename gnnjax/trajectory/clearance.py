"""How far rounded paths stay from obstacles, proven all along."""

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.margins import largest_margin
from gnnjax.scene.scene import Scene, inflated
from gnnjax.trajectory.curve import blend_chords, straight_pieces
from gnnjax.trajectory.smooth import Smoothed

_CHORDS = 16  # of a blend, even: what curves stray from these is a millimetre at most, an arm's
# length away


def clearances_of(robot: Robot, scene: Scene, paths: list[Smoothed]) -> list[dict[str, float]]:
    """`clearance_before` and `clearance` [m] of P paths, as they were and rounded; 0 where they are
    not certified. In one scene or in P scenes `[P, M, ...]`, one each."""
    found = []
    for i, (path, blends, certified) in enumerate(paths):
        several = np.ndim(scene.mask) == 2
        own = jax.tree.map(lambda x, i=i: x[i], scene) if several else scene
        each = {"clearance_before": np.zeros_like(blends), "clearance": blends}
        found.append(
            {
                name: curve_clearance(robot, own, path, wide) if certified else 0.0
                for name, wide in each.items()
            }
        )
    return found


def curve_clearance(robot: Robot, scene: Scene, path: np.ndarray, blends: np.ndarray) -> float:
    """The distance [m] from all obstacles that is proven along a rounded path.

    Args:
        robot: the arm.
        scene: one scene.
        path: `[L D]` without repetitions.
        blends: `[L - 2]`, of its corners; 0: not rounded.
    """
    starts, ends = straight_pieces(path, blends)
    slack = np.zeros_like(starts)
    wide = np.flatnonzero(blends)
    if len(wide):
        points, stray = blend_chords(path, wide + 1, blends[wide], _CHORDS)
        rows = (points[:, :-1], points[:, 1:], stray)
        flat = (x.reshape(-1, path.shape[1]) for x in rows)
        starts, ends, slack = (
            np.concatenate(both) for both in zip((starts, ends, slack), flat, strict=True)
        )

    def proves(margin: float) -> bool:
        thick = inflated(scene, margin)
        return bool(certify_edges(robot, thick, starts, ends, slack=slack).all())

    return largest_margin(proves) or 0.0
