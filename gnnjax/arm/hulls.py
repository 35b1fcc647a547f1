"""Convex hulls of links, with fewer vertices."""

import functools

import mujoco
import numpy as np
from jaxtyping import Float

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.kept import kept_result

# By how much the hulls that are tested may stand out of the true ones, m; and by no more than this
# share of their longest side, or the parts of a small arm would touch each other always.
SIMPLER, _SHARE = 2e-3, 0.02
# Nor by more than this share of the widest gap that a part has to one that it must stay clear of: a
# wrist that turns within a fork always is a few millimetres from it.
_OF_GAP, _SAMPLES = 0.125, 64
_LEAST = 2e-4  # m; finer hulls have hundreds of vertices, which all parts pay for
_SLACK = 1e-6  # m; on the ball, for rounding


def simplify(
    vertices: Float[np.ndarray, "V 3"], tolerance: float
) -> tuple[Float[np.ndarray, "W 3"], float]:
    """Some of a hull's vertices and a ball around each point of theirs that enclose it.

    The vertex that sticks out farthest is added until none does by more than the tolerance.

    Args:
        vertices: of the hull, m.
        tolerance: bound on the ball's radius, m.

    Returns:
        the vertices that are kept; the radius, m.

    Raises:
        InputError: the tolerance leaves no room for rounding.
    """
    if not tolerance > _SLACK:
        raise InputError(f"hulls cannot be simplified to {tolerance} m; take more than {_SLACK}")
    # A third of a second, which only those pay who read meshes.
    from scipy.optimize import nnls

    points = vertices.astype(np.float64)
    middle = points.mean(axis=0)
    points -= middle
    scale = np.abs(points).max() + 1e-9

    def sticks_out(point: np.ndarray, chosen: list[int]) -> float:
        """An upper bound, exact but for rounding: the distance from some point of the hull."""
        corners = points[chosen]
        system = np.vstack([corners.T / scale, np.full(len(corners), 1e3)])
        weights, _ = nnls(system, np.append(point / scale, 1e3))
        return float(np.linalg.norm(weights @ corners / weights.sum() - point))

    chosen = [int(np.argmax(np.linalg.norm(points, axis=1)))]
    # Distances only fall as the hull grows: old ones are bounds, and few need another look.
    bounds = np.linalg.norm(points - points[chosen[0]], axis=1)
    seen = np.ones(len(points), int)
    while True:
        farthest = int(np.argmax(bounds))
        if seen[farthest] < len(chosen):
            bounds[farthest] = min(bounds[farthest], sticks_out(points[farthest], chosen))
            seen[farthest] = len(chosen)
        elif bounds[farthest] > tolerance - _SLACK:
            chosen.append(farthest)
            bounds[farthest] = 0.0
        else:
            return vertices[sorted(chosen)], float(bounds[farthest]) + _SLACK


def _widest_gaps(robot: Robot) -> np.ndarray:
    """Of each part, the widest gap in some configurations to the one that always is nearest, as
    far as it matters, `[T]` m. Of parts that touch in all of them it tells nothing."""
    model, rng, far = robot.mj_model, np.random.default_rng(0), SIMPLER / _OF_GAP
    data, widest = mujoco.MjData(model), np.zeros(len(robot.part_pairs))
    geoms = robot.part_geoms[robot.part_pairs].tolist()
    for q in rng.uniform(robot.joint_lower, robot.joint_upper, (_SAMPLES, robot.num_dof)):
        near = np.flatnonzero(widest < far).tolist()
        if not near:
            break
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for i in near:
            gap = mujoco.mj_geomDistance(model, data, *geoms[i], far, None)
            widest[i] = max(widest[i], gap)
    gaps = np.full(len(robot.parts), np.inf)
    np.minimum.at(gaps, robot.part_pairs, np.where(widest > 0, widest, np.inf)[:, None])
    return gaps


@functools.cache
def simpler_hulls(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `[T V 3]` and radii `[T]` of the arm's parts, with few vertices each, which stand
    out by `SIMPLER` at most; a second of work that kernels and certificates share."""

    def simpler(vertices: np.ndarray, gap: float) -> tuple[np.ndarray, float]:
        if len(vertices) <= 8:
            return vertices, 0.0
        longest = float(np.ptp(vertices, axis=0).max())
        most = min(SIMPLER, _SHARE * longest, max(_OF_GAP * gap, _LEAST))
        return kept_result(simplify, vertices, max(most, 2 * _SLACK))

    gaps = _widest_gaps(robot)
    simple = [simpler(p.vertices, gap) for p, gap in zip(robot.parts, gaps.tolist(), strict=True)]
    most = max(len(vertices) for vertices, _ in simple)
    vertices = [np.pad(v, ((0, most - len(v)), (0, 0)), "edge") for v, _ in simple]
    radii = [p.radius + more for p, (_, more) in zip(robot.parts, simple, strict=True)]
    return np.array(vertices, np.float32), np.array(radii, np.float32)
