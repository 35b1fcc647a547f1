"""Certification: a path is collision-free at every instant, not only where it was tested.

Conservative advancement in NumPy and double precision, apart from the planning kernels, so that
both would have to be wrong for a colliding path to pass.
"""

import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.collision.bounds import obstacles_of, spheres_of
from gnnjax.errors import InputError
from gnnjax.scene.scene import Scene

# Pieces of a path shorter than this (configuration units) are not cut further: a path that comes
# this close to touching is refused.
_SHORTEST_PIECE = 1e-4
_FIRST_CUT = 0.4  # configuration units; longer pieces are hardly ever free as a whole
_PIECES_A_BATCH = 512


def certify_path(robot: Robot, scene: Scene, path: ArrayLike) -> bool:
    """Proves that a path is free of collisions, boxes and the arm itself, along its whole length.

    The path is cut into pieces. A piece is free when, at its middle, every collision geom is
    farther from everything else than any of its points can move until the piece's ends; otherwise
    the piece is cut further. Capsules count as chains of spheres that enclose them.

    Args:
        robot: the arm, with spheres and capsules as collision geoms.
        scene: one scene.
        path: `[L, D]` configurations, one or more, joined by straight lines.

    Returns:
        True if proven free; False if a collision was found or the path grazes something too
        closely to tell, leaves the joint limits, or is not a number somewhere.

    Raises:
        InputError: a path of another shape, or a scene with boxes that are none: whatever was
            checked before, a scene must be finite, its boxes have a size, and its quaternions be
            normalized.
    """
    path = _configurations(robot, "path", path)
    if not len(path):
        raise InputError("the path holds no configuration; give at least one")
    last = max(1, len(path) - 1)  # a single configuration is its own end
    return bool(certify_edges(robot, scene, path[:last], path[-last:]).all())


def certify_edges(robot: Robot, scene: Scene, starts: ArrayLike, ends: ArrayLike) -> np.ndarray:
    """`certify_path` for each straight line from `starts` to `ends` `[E, D]`; returns `[E]`."""
    starts, ends = _configurations(robot, "starts", starts), _configurations(robot, "ends", ends)
    if len(starts) != len(ends):
        raise InputError(f"{len(starts)} starts and {len(ends)} ends; give one of each an edge")
    # Half an ulp of single precision: limits are stored as float32.
    slack = 1e-6
    lower, upper = robot.joint_lower - slack, robot.joint_upper + slack
    certified = np.ones(len(starts), bool)
    for q in (starts, ends):
        certified &= ((q >= lower) & (q <= upper)).all(axis=1)
    body, obstacles = spheres_of(robot), obstacles_of(scene)
    edge = np.flatnonzero(certified)
    edge, low, high = _cut(
        edge, starts[edge], ends[edge], _lengths(starts, ends)[edge] / _FIRST_CUT
    )
    while len(edge):
        now, later = slice(_PIECES_A_BATCH), slice(_PIECES_A_BATCH, None)
        owner, begin, end = edge[now], low[now], high[now]
        half = np.abs(end - begin) / 2
        clearance, need = body.clearance_and_need(obstacles, (begin + end) / 2, half)
        touching = (clearance <= 0) | ((need >= 1) & (_lengths(begin, end) < _SHORTEST_PIECE))
        certified[owner[touching]] = False
        split = need >= 1
        # As many parts as would do if the clearance were the same all along.
        parts = _cut(owner[split], begin[split], end[split], np.clip(need[split] * 1.2, 2, 8))
        edge, low, high = (
            np.concatenate([new, old[later]])
            for new, old in zip(parts, (edge, low, high), strict=True)
        )
        left = certified[edge]
        edge, low, high = edge[left], low[left], high[left]
    return certified


def _configurations(robot: Robot, name: str, values: ArrayLike) -> np.ndarray:
    """Configurations `[N, D]` in double precision, or what is wrong with them."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        raise InputError(f"{name} is not an array of numbers; give [N, {robot.num_dof}]") from None
    if array.ndim != 2 or array.shape[1] != robot.num_dof:
        raise InputError(
            f"{name} has shape {array.shape}; {robot.name} needs [N, {robot.num_dof}], a row of "
            "joint values each"
        )
    return array


def _lengths(starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    return np.linalg.norm(ends - starts, axis=1)


def _cut(
    owner: np.ndarray, low: np.ndarray, high: np.ndarray, parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cuts lines into at least `parts` equal pieces, in order; neighbours share their ends."""
    parts = np.maximum(1, np.ceil(parts)).astype(int)
    row = np.repeat(np.arange(len(owner)), parts)
    step = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
    number = parts[row]

    def at(index: np.ndarray) -> np.ndarray:
        fraction = (index / number)[:, None]
        point = low[row] + fraction * (high - low)[row]
        # The very end, not what rounding makes of it.
        return np.where(fraction == 1, high[row], point)

    return owner[row], at(step), at(step + 1)


def configuration_clearance(robot: Robot, scene: Scene, q: np.ndarray) -> float:
    """Distance [m] of the arm at q `[D]` to boxes and itself; negative in collision."""
    still = np.zeros((1, robot.num_dof))
    q = _configurations(robot, "q[None]", np.asarray(q)[None])
    return float(spheres_of(robot).clearance_and_need(obstacles_of(scene), q, still)[0][0])


def self_clearance(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Distances [m] of the arm at `[B, D]` configurations to itself, `[B]`; inf without pairs."""
    nothing = Scene(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0, bool))
    still = np.zeros((len(q), robot.num_dof))
    body = spheres_of(robot)
    return body.clearance_and_need(obstacles_of(nothing), np.asarray(q, float), still)[0]


def check_scene(scene: Scene) -> None:
    """Refuses a scene that nothing can be proven in.

    Raises:
        InputError: a box that is not finite, has no size, or a quaternion that is not normalized.
    """
    obstacles_of(scene)


def path_clearance(robot: Robot, scene: Scene, path: np.ndarray, resolution: float) -> float:
    """Least distance [m] of the arm to boxes and itself along a path, seen at samples.

    Args:
        robot: the arm.
        scene: one scene.
        path: `[L, D]` configurations, two or more, joined by straight lines.
        resolution: largest distance of neighbouring samples, configuration units.
    """
    path = _configurations(robot, "path", path)
    pieces = _lengths(path[:-1], path[1:]) / resolution
    _, starts, _ = _cut(np.arange(len(path) - 1), path[:-1], path[1:], pieces)
    samples = np.concatenate([starts, path[-1:]])
    still = np.zeros((1, robot.num_dof))
    return float(spheres_of(robot).clearance_and_need(obstacles_of(scene), samples, still)[0].min())
