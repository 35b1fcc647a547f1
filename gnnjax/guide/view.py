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

from gnnjax.arm.kinematics import body_frames, dot, joint_terms, subtract, transform_point
from gnnjax.arm.robot import Robot
from gnnjax.collision.spheres import moved_by_joint
from gnnjax.scene.geometry import signed_distance
from gnnjax.scene.lookup import distances_to
from gnnjax.scene.scene import Scene, rotation_matrices

# m; what a scene without obstacles is away from everything.
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
    bodies = robot.sphere_bodies[moving] + 1
    turns = data.xmat[bodies].reshape(-1, 3, 3)
    centers = data.xpos[bodies] + np.einsum("gij,gj->gi", turns, robot.sphere_centers[moving])
    chosen = [len(moving) - 1]
    while len(chosen) < min(num, len(moving)):
        gaps = np.linalg.norm(centers[:, None] - centers[chosen], axis=-1).min(axis=1)
        chosen.append(int(gaps.argmax()))
    spread = np.resize(sorted(chosen), num) if len(chosen) < num else np.array(chosen)
    return tuple(int(moving[i]) for i in np.sort(spread))


def point_distances(robot: Robot, num: int) -> Callable[[Scene, jax.Array], jax.Array]:
    """Makes the function `(scene, q [B D]) -> [B P]`: signed distances [m] to the nearest
    obstacle, negative inside: minus the way out of it.
    """
    points = choose_points(robot, num)
    centers = [robot.sphere_centers[g].tolist() for g in points]

    def distances(scene: Scene, q: Float[Array, "B D"]) -> Float[Array, "B P"]:
        joints = joint_terms(robot, q)
        turned = jnp.swapaxes(rotation_matrices(scene.quats), -1, -2)  # world to obstacle
        order = jnp.argsort(~scene.mask)  # existing ones first

        def nearer(i, nearest):
            # As in the collision kernels: kinematics anew for every box, one array a component,
            # are four times faster than positions that go through memory.
            fresh, nearest = jax.lax.optimization_barrier((joints, nearest))
            frames = body_frames(robot, fresh)
            at = order[i]
            nearer_now = []
            for g, center, near in zip(points, centers, nearest, strict=True):
                position, rotation = frames[robot.sphere_bodies[g]]
                offset = subtract(
                    transform_point(position, rotation, center), list(scene.centers[at])
                )
                seen = [dot(list(row), offset) for row in turned[at]]
                away = signed_distance(seen, list(scene.half_extents[at]), *scene.radii[at])
                nearer_now.append(jnp.where(away < near, away, near))
            return nearer_now

        far = jnp.full(q.shape[:1], _NOTHING_NEAR, q.dtype)
        found = jax.lax.fori_loop(0, scene.mask.sum(), nearer, [far] * len(points))
        if scene.cloud is not None:
            frames = body_frames(robot, joints)
            for i, (g, center) in enumerate(zip(points, centers, strict=True)):
                position, rotation = frames[robot.sphere_bodies[g]]
                away = distances_to(scene.cloud, transform_point(position, rotation, center))
                found[i] = jnp.where(away < found[i], away, found[i])
        return jnp.stack(found, axis=-1)

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
    radii = robot.sphere_radii[list(points)]
    distances = point_distances(robot, num)
    bodies = robot.sphere_bodies
    can_touch = {frozenset(pair) for pair in bodies[robot.sphere_pairs].tolist()}
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
            where.append(transform_point(position, rotation, robot.sphere_centers[g].tolist()))
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
