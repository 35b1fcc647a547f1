"""Certification: a path is collision-free at every instant, not only where it was tested.

Conservative advancement in NumPy and double precision, apart from the planning kernels, so that
both would have to be wrong for a colliding path to pass.
"""

import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.collision.bounds import spheres_of
from gnnjax.collision.gaps import gaps_of, members
from gnnjax.collision.obstacles import Obstacles, obstacles_of, owners_of, scene_faults
from gnnjax.collision.travel import Moments, straight_motions
from gnnjax.errors import InputError, as_typed, brief
from gnnjax.scene.allowed import check_allowed, check_arm
from gnnjax.scene.scene import Scene, check_is_scene, check_single

# Pieces of a path shorter than this (configuration units) are not cut further: a path that comes
# this close to touching is refused.
_SHORTEST_PIECE = 1e-4
# Half an ulp of single precision: joint limits are stored as float32.
_ROUNDED = 1e-6
FIRST_CUT = 0.2  # configuration units; longer pieces are hardly ever free as a whole
PIECES_A_BATCH = 1024  # whose arrays fit into a core's cache
_EDGES_A_BLOCK = 1024  # of which pieces are kept at a time


def certify_path(robot: Robot, scene: Scene, path: ArrayLike) -> bool:
    """Proves that a path is free of collisions, with obstacles and the arm itself, along its whole
    length, but for allowed contacts (`allow_contacts`). Of torques it says nothing (`time_path`).

    The path is cut into pieces. A piece is free when, at its middle, every part of the arm is
    farther from everything else than any of its points can move until the piece's ends
    (`travel.py`); otherwise the piece is cut further. The spheres around the arm's parts are
    looked at first; where they leave it open, the convex parts themselves.

    Args:
        robot: the arm.
        scene: one scene.
        path: `[L, D]` configurations, one or more, joined by straight lines.

    Returns:
        True if proven free; False if a collision was found or the path grazes something too
        closely to tell, leaves the joint limits, or is not a number somewhere.

    Raises:
        InputError: a path of another shape, or a scene with obstacles that are none: whatever
            was checked before, a scene must be finite, its obstacles have a size, and its
            quaternions be normalized.
    """
    path = configurations_of(robot, "path", path)
    if not len(path):
        raise InputError("the path holds no configuration; give at least one")
    last = max(1, len(path) - 1)  # a single configuration is its own end
    return bool(certify_edges(robot, scene, path[:last], path[-last:]).all())


def certify_edges(
    robot: Robot,
    scene: Scene | Obstacles,
    starts: ArrayLike,
    ends: ArrayLike,
    owner: ArrayLike | None = None,
    slack: ArrayLike | None = None,
) -> np.ndarray:
    """`certify_path` for each straight line from `starts` to `ends` `[E, D]`; returns `[E]`.

    Whether an edge is certified does not depend on those beside it. With `slack` all curves are
    certified along with a line that are within the joint limits and, at each fraction of the way,
    within the slack of the line's point.

    Args:
        robot: the arm.
        scene: one scene, or P scenes `[P, M, ...]`; or their `known_obstacles`.
        starts: `[E, D]` configurations.
        ends: `[E, D]` configurations.
        owner: `[E]`, in which of P scenes each edge is; None for one scene.
        slack: `[E, D]` how far each joint may be from the line, rad or m; None: not at all.

    Raises:
        InputError: arrays of other shapes, or a scene with obstacles that are none.
    """
    starts, ends = (
        configurations_of(robot, "starts", starts),
        configurations_of(robot, "ends", ends),
    )
    wide = None if slack is None else configurations_of(robot, "slack", slack)
    if wide is not None and (
        len(wide) != len(starts) or not ((wide >= 0) & np.isfinite(wide)).all()
    ):
        raise InputError(f"slack {brief(slack)} for {len(starts)} edges; give lengths, a row each")
    if len(starts) != len(ends):
        raise InputError(f"{len(starts)} starts and {len(ends)} ends; give one of each an edge")
    obstacles = known_obstacles(robot, scene)
    owner = owners_of(obstacles, owner, len(starts))
    certified = _within_limits(robot, starts) & _within_limits(robot, ends)
    inside = np.flatnonzero(certified)
    for first in range(0, len(inside), _EDGES_A_BLOCK):
        edge = inside[first : first + _EDGES_A_BLOCK]
        ways = starts[edge], ends[edge]
        tube = None if wide is None else wide[edge]
        certified[edge] = _certify_block(robot, obstacles, *ways, owner[edge], tube)
    return certified


def _certify_block(
    robot: Robot,
    obstacles: Obstacles,
    starts: np.ndarray,
    ends: np.ndarray,
    owner: np.ndarray,
    slack: np.ndarray | None,
) -> np.ndarray:
    """Certifies edges `[E, D]` within the joint limits; returns `[E]`.

    Pieces are kept as fractions from 0 to 1 of the edge that they belong to. From its middle to
    its ends, a piece moves everything by at most half its fraction of what the edge does, and by
    the slack.
    """
    body, lengths = spheres_of(robot), np.linalg.norm(ends - starts, axis=1)
    begin, way = starts.T.copy(), (ends - starts).T.copy()
    motions = straight_motions(body, way, None if slack is None else slack.T)
    shortest = np.full(len(starts), _SHORTEST_PIECE)
    if slack is not None:  # cutting what is shorter leaves most of the motion as it is
        shortest = np.maximum(shortest, np.linalg.norm(slack, axis=1))
    certified = np.ones(len(starts), bool)
    whole = np.arange(len(starts)), np.zeros(len(starts)), np.ones(len(starts))
    edge, low, high = cut(*whole, lengths / FIRST_CUT)
    while len(edge):
        now, later = _next_batch(edge)
        of, near, far = edge[now], low[now], high[now]
        q = begin[:, of] + (near + far) / 2 * way[:, of]
        found = gaps_of(body, obstacles, Moments(q, owner[of], of, (far - near) / 2), motions)
        # The largest share of a gap that the motion can use up: below 1 nothing is touched.
        need = np.zeros(len(of))
        np.maximum.at(need, found.moment, found.motion / np.maximum(found.gap, 1e-12))
        certified[of[found.moment[found.touching]]] = False
        is_open = ~(need < 1)  # NaN proves nothing
        certified[of[is_open & ~((far - near) * lengths[of] >= shortest[of])]] = False
        split = is_open & certified[of]
        # As many parts as would do if the clearance were the same all along.
        parts = cut(of[split], near[split], far[split], np.clip(need[split] * 1.2, 2, 8))
        edge, low, high = (
            np.concatenate([new, old[later]])
            for new, old in zip(parts, (edge, low, high), strict=True)
        )
        left = certified[edge]
        edge, low, high = edge[left], low[left], high[left]
    return certified


def _next_batch(edge: np.ndarray) -> tuple[np.ndarray | slice, np.ndarray | slice]:
    """Which pieces of edges `[N]` to look at now, and which later.

    The first of each edge, which are its shortest: one of them that fails spares all others.
    """
    if len(edge) <= PIECES_A_BATCH:
        return slice(None), slice(0)
    order = np.argsort(edge, kind="stable")
    _, count = np.unique(edge, return_counts=True)
    rank = np.empty(len(edge), int)
    _, rank[order] = members(np.zeros(len(count), int), count)
    now = np.sort(np.argsort(rank, kind="stable")[:PIECES_A_BATCH])
    return now, np.delete(np.arange(len(edge)), now)


def beyond_limits(robot: Robot, q: np.ndarray, slack: float = _ROUNDED) -> str:
    """Which joint of configurations `[N, D]` is not within its limits, as words that go on from
    what has it; none where all are."""
    beyond = ~_inside(robot, q, slack)
    if not beyond.any():
        return ""
    row, joint = (int(x[0]) for x in np.nonzero(beyond))
    low, high = (as_typed(x[joint]) for x in (robot.joint_lower, robot.joint_upper))
    return (
        f"has joint {robot.joint_names[joint]} at {q[row, joint]:.8g}, beyond its limits {low:g} "
        f"to {high:g}"
    )


def _within_limits(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Whether configurations `[N, D]` are numbers within the joint limits, `[N]`."""
    return np.all(_inside(robot, q, _ROUNDED), axis=1)


def _inside(robot: Robot, q: np.ndarray, slack: float) -> np.ndarray:
    return (q >= robot.joint_lower - slack) & (q <= robot.joint_upper + slack)


def known_obstacles(robot: Robot, scene: Scene | Obstacles) -> Obstacles:
    """What the scene or scenes hold, for all that is asked of them for an arm.

    Raises:
        InputError: a scene that nothing can be proven in, or contacts that are meant of another
            arm.
    """
    if isinstance(scene, Obstacles):
        if scene.allowed is not None:
            check_arm(robot, scene.arm)
        return scene
    check_is_scene(scene)
    check_allowed(robot, scene)
    return obstacles_of(scene)


def configurations_of(robot: Robot, name: str, values: ArrayLike) -> np.ndarray:
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


def cut(
    edge: np.ndarray, low: np.ndarray, high: np.ndarray, parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cuts pieces into at least `parts` equal pieces, in order; neighbours share their ends."""
    parts = np.maximum(1, np.ceil(parts)).astype(int)
    row, step = members(np.zeros(len(parts), int), parts)
    number = parts[row]

    def at(index: np.ndarray) -> np.ndarray:
        fraction = index / number
        point = low[row] + fraction * (high - low)[row]
        # The very end, not what rounding makes of it.
        return np.where(fraction == 1, high[row], point)

    return edge[row], at(step), at(step + 1)


def check_scene(scene: Scene) -> None:
    """Refuses one scene that nothing can be proven in.

    Raises:
        InputError: what is no scene, or several; a box that is not finite, has no size, or a
            quaternion that is not normalized.
    """
    check_single(scene)
    for fault in scene_faults(scene):
        if fault is not None:
            raise InputError(fault)
