"""How far a path provably stays from all obstacles."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import beyond_limits, certify_path
from gnnjax.errors import InputError
from gnnjax.scene.scene import Scene, inflated

_MILLIMETER = 1e-3  # m; how finely margins are looked for
MOST_MARGIN = 0.25  # m, beyond which none is looked for


def proven_clearance(
    robot: Robot, scene: Scene, path: ArrayLike, most: float = MOST_MARGIN
) -> float:
    """A distance [m] that the arm provably keeps from all obstacles along the whole of a path.

    The largest that the certificate finds, to a millimetre: `certify_path` with obstacles that much
    larger. How near the arm comes to itself does not matter, as long as the path is free.

    Args:
        robot: the arm.
        scene: one scene.
        path: see `certify_path`.
        most: distance beyond which none is looked for, m; it is the result where nothing is nearer.

    Raises:
        InputError: see `certify_path`; or the path is not certified at all, and has none.
    """
    found = largest_margin(lambda margin: certify_path(robot, inflated(scene, margin), path), most)
    if found is None:
        why = beyond_limits(robot, np.asarray(path, float)) or "is not certified"
        raise InputError(f"the path {why}, so that it has no clearance; plan another one")
    return found


def largest_margin(proves: Callable[[float], bool], most: float = MOST_MARGIN) -> float | None:
    """The largest distance [m] up to `most` for which something is proven, to a millimetre; None
    where it is not even for 0."""
    if not proves(0.0):
        return None
    if proves(most):
        return most
    low, high = 0.0, most
    while high - low > _MILLIMETER:
        middle = (low + high) / 2
        low, high = (middle, high) if proves(middle) else (low, middle)
    return low
