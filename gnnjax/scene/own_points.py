"""What a depth camera sees of the arm itself, taken out of its points.

Distances are to the arm's parts as they are (`Robot.parts`), not to the spheres around them.
"""

import functools
from collections.abc import Sequence

import mujoco
import numpy as np

from gnnjax.arm.parts import Part
from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, as_floats, brief, check_number
from gnnjax.scene.cloud import checked_points

MARGIN = 0.03  # m, unless told
_POINTS_A_TURN = 4096  # which bounds the memory of points times faces


def without_robot(
    points: Sequence | np.ndarray,
    robot: Robot,
    configuration: Sequence | np.ndarray,
    margin: float = MARGIN,
    *,
    source: str = "the cloud",
) -> np.ndarray:
    """The points that are farther than `margin` from the arm, and from what it holds.

    What stands that near to the arm is taken out with it. So the margin should be no more than the
    errors of the camera and of the joint values; and a configuration in which the arm is near to
    what it works at is none to look from.

    Args:
        points: `[K, 3]` m, in the frame of the arm's base.
        robot: the arm.
        configuration: `[D]` where it was when they were seen.
        margin: m.
        source: how error messages call the cloud.

    Returns:
        `[L, 3]`, in their order; none may be left.

    Raises:
        InputError: points or configuration of another shape or not finite, a negative margin.
    """
    array = checked_points(points, source)
    try:
        q = as_floats(configuration)
    except (TypeError, ValueError, OverflowError):
        q = np.zeros(0)
    if q.shape != (robot.num_dof,) or not np.isfinite(q).all():
        raise InputError(
            f"{source} was seen with {robot.name} at {brief(configuration)}; give "
            f"{robot.num_dof} finite joint values"
        )
    check_number(margin, f"margin of {source} to the arm")
    if not 0 <= margin < np.inf:
        raise InputError(f"margin of {source} to the arm is {margin}; give 0 or more (m)")
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    own = np.zeros(len(array), bool)
    for part in robot.parts:
        turn = data.xmat[part.body + 1].reshape(3, 3)  # MuJoCo's body 0 is the world
        left = np.flatnonzero(~own)
        seen = (array[left] - data.xpos[part.body + 1]) @ turn
        own[left] = _is_near(part, seen, margin)
    return array[~own]


def _is_near(part: Part, points: np.ndarray, margin: float) -> np.ndarray:
    """Which of points `[K, 3]` in its body's frame are within `margin` of a part."""
    middle = (part.vertices.min(axis=0) + part.vertices.max(axis=0)) / 2
    around = np.sqrt(((part.vertices - middle) ** 2).sum(axis=1).max())
    reach = part.radius + margin
    near = ((points - middle) ** 2).sum(axis=1) <= (around + reach) ** 2
    rows = np.flatnonzero(near)
    for chosen in np.split(rows, range(_POINTS_A_TURN, len(rows), _POINTS_A_TURN)):
        near[chosen] = distances_to_hull(part.vertices, points[chosen]) <= reach
    return near


def distances_to_hull(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances of points `[K, 3]` to the convex hull of `[V, 3]`, not above 0 inside.

    The greatest height above a face is no more than the distance. It is the distance where its foot
    is in the hull; else the nearest point is on an edge.
    """
    normals, offsets, edges = _faces_and_edges(vertices.tobytes())
    found = np.full(len(points), np.inf)
    left = np.ones(len(points), bool)
    if len(normals):
        heights = points @ normals.T + offsets
        face = heights.argmax(axis=1)
        found = heights[np.arange(len(points)), face]
        feet = points - found[:, None] * normals[face]
        left = (found > 0) & ((feet @ normals.T + offsets).max(axis=1) > 1e-9)
        found[left] = np.inf
    for first, last in vertices[edges]:
        way = last - first
        away = points[left] - first
        share = np.clip(away @ way / max(way @ way, 1e-300), 0, 1)
        beside = np.sqrt(((away - share[:, None] * way) ** 2).sum(axis=1))
        found[left] = np.minimum(found[left], beside)
    return found


@functools.lru_cache(maxsize=256)
def _faces_and_edges(vertices: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outward normals `[F, 3]` and offsets `[F]` of a hull's faces, and its edges `[E, 2]`."""
    points = np.frombuffer(vertices).reshape(-1, 3)
    if len(points) < 3:  # of a sphere or a capsule, which are points made thicker
        return np.zeros((0, 3)), np.zeros(0), np.array([[0, len(points) - 1]])
    from scipy.spatial import ConvexHull  # a fifth of a second, for clouds alone

    hull = ConvexHull(points)
    corners = hull.simplices
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    return hull.equations[:, :3], hull.equations[:, 3], edges
