"""Where the arm is in the workspace: distances of a few of its points to the obstacles.

What a network reads, not a collision check: points without thickness, a dozen of them, where the
checker tests dozens of spheres.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from gnnjax.arm.kinematics import Vector, body_frames, dot, joint_terms, subtract, transform
from gnnjax.arm.robot import Robot
from gnnjax.collision.fused import moved_by_joint
from gnnjax.scene.scene import Scene, rotation_matrices
from gnnjax.scene.shapes import for_every_kind

# What boxes that do not exist are away from everything, and what a scene without boxes is, m.
_NOTHING_NEAR = 10.0
_SELF_FAR = 1.0  # m; the arm's distance to itself counts up to this


@functools.cache
def choose_points(robot: Robot, num: int) -> tuple[int, ...]:
    """Collision geoms whose centres stand for the arm: spread out, from the base to the tip.

    Farthest-point sampling of the geoms that joints move, at the home configuration, starting from
    the last one. An arm with fewer geoms repeats some.
    """
    moving = np.flatnonzero(moved_by_joint(robot))
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = robot.home
    mujoco.mj_kinematics(robot.mj_model, data)
    bodies = robot.geom_bodies[moving] + 1
    turns = data.xmat[bodies].reshape(-1, 3, 3)
    centers = data.xpos[bodies] + np.einsum("gij,gj->gi", turns, robot.geom_centers[moving])
    chosen = [len(moving) - 1]
    while len(chosen) < min(num, len(moving)):
        gaps = np.linalg.norm(centers[:, None] - centers[chosen], axis=-1).min(axis=1)
        chosen.append(int(gaps.argmax()))
    spread = np.resize(sorted(chosen), num) if len(chosen) < num else np.array(chosen)
    return tuple(int(moving[i]) for i in np.sort(spread))


def point_distances(robot: Robot, num: int) -> Callable[[Scene, jax.Array], jax.Array]:
    """Makes the function `(scene, q [B D]) -> [B P]`: signed distances [m] to the nearest box.

    Negative inside a box: minus the way out of it.
    """
    points = choose_points(robot, num)
    centers = [robot.geom_centers[g].tolist() for g in points]

    def distances(scene: Scene, q: Float[Array, "B D"]) -> Float[Array, "B P"]:
        joints = joint_terms(robot, q)
        turned = jnp.swapaxes(rotation_matrices(scene.quats), -1, -2)  # world to box
        order = jnp.argsort(~scene.mask)  # existing boxes first

        def nearer(i, nearest):
            # As in the collision kernels: kinematics anew for every box, one array a component,
            # are four times faster than positions that go through memory.
            fresh, nearest = jax.lax.optimization_barrier((joints, nearest))
            frames = body_frames(robot, fresh)
            box = scene.centers[order[i]], scene.half_extents[order[i]], turned[order[i]]
            nearer_now = []
            for g, center, near in zip(points, centers, nearest, strict=True):
                position, rotation = frames[robot.geom_bodies[g]]
                nearer_now.append(_NEARER["box"](near, box, transform(position, rotation, center)))
            return nearer_now

        far = jnp.full(q.shape[:1], _NOTHING_NEAR, q.dtype)
        start = [(jnp.square(far), jnp.zeros_like(far))] * len(points)
        found = jax.lax.fori_loop(0, scene.mask.sum(), nearer, start)
        # Of the two, one is zero: a point is outside all boxes, or inside of one.
        return jnp.stack([jnp.sqrt(squared) + depth for squared, depth in found], axis=-1)

    return distances


class ArmView(NamedTuple):
    """What a network reads of the arm at a configuration."""

    # m, of P points to the nearest box, less the arm's thickness there; then of the arm to itself.
    clearance: Float[Array, "*batch Q"]
    points: Float[Array, "*batch P 3"]  # m, where the points are


def arm_view(robot: Robot, num: int) -> Callable[[Scene, jax.Array], ArmView]:
    """Makes the function `(scene, q [B D]) -> ArmView [B]` of `num` points of an arm, Q = P + 1.

    The distance of the arm to itself is that of the nearest pair of the points whose links can
    touch each other.
    """
    points = choose_points(robot, num)
    radii = robot.geom_radii[list(points)]
    distances = point_distances(robot, num)
    bodies = robot.geom_bodies
    can_touch = {frozenset(pair) for pair in bodies[robot.self_pairs].tolist()}
    pairs = [
        (i, j)
        for i, first in enumerate(points)
        for j, second in enumerate(points[:i])
        if frozenset((int(bodies[first]), int(bodies[second]))) in can_touch
    ]

    def view(scene: Scene, q: Float[Array, "B D"]) -> ArmView:
        frames = body_frames(robot, joint_terms(robot, q))
        where = []  # P points of 3 arrays
        for g in points:
            position, rotation = frames[bodies[g]]
            where.append(transform(position, rotation, robot.geom_centers[g].tolist()))
        to_itself = jnp.full(q.shape[:1], _SELF_FAR, q.dtype)
        for i, j in pairs:
            apart = subtract(where[i], where[j])
            gap = jnp.sqrt(dot(apart, apart) + 1e-12) - float(radii[i] + radii[j])
            to_itself = jnp.where(gap < to_itself, gap, to_itself)
        to_boxes = distances(scene, q) - jnp.asarray(radii, q.dtype)
        stacked = [jnp.stack([jnp.broadcast_to(x, q.shape[:1]) for x in p], -1) for p in where]
        clearance = jnp.concatenate([to_boxes, to_itself[:, None]], axis=-1)
        return ArmView(clearance, jnp.stack(stacked, axis=-2))

    return jax.jit(view)  # traced once a shape


def _nearer(
    nearest: tuple[jax.Array, jax.Array],
    box: tuple[jax.Array, jax.Array, jax.Array],
    point: Vector,
) -> tuple[jax.Array, jax.Array]:
    """Squared distance to the nearest box, and minus the depth in the deepest, with one box more.

    Comparisons are written as `where`, as in `geometry.py`.

    Args:
        nearest: both, for the boxes before.
        box: centre [3], half extents [3] and rotation from the world [3 3].
        point: of the arm, three arrays.
    """
    (squared, depth), (center, half_extents, turned) = nearest, box
    offset = subtract(point, list(center))
    beyond = [jnp.abs(dot(list(turned[r]), offset)) - half_extents[r] for r in range(3)]
    outside = [jnp.where(b > 0.0, b, 0.0) for b in beyond]
    apart = jnp.asarray(dot(outside, outside))
    inside = beyond[0]
    for b in beyond[1:]:
        inside = jnp.where(b > inside, b, inside)
    return jnp.where(apart < squared, apart, squared), jnp.where(inside < depth, inside, depth)


_NEARER = for_every_kind("view of the arm", box=_nearer)
