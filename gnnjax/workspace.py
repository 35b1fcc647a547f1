"""Where the arm is in the workspace: distances of a few of its points to the obstacles.

What a network reads, not a collision check: points without thickness, a dozen of them, where the
checker tests dozens of spheres.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from gnnjax.collision import moved_by_joint
from gnnjax.kinematics import body_frames, joint_terms, transform
from gnnjax.robot import Robot
from gnnjax.scene import Scene, rotation_matrices

# What boxes that do not exist are away from everything, and what a scene without boxes is, m.
_NOTHING_NEAR = 10.0


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
    centers = data.geom_xpos[robot.geom_ids[moving]]
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

    def distances(scene: Scene, q: Float[Array, "B D"]) -> Float[Array, "B P"]:
        frames = body_frames(robot, joint_terms(robot, q))
        world = [
            transform(position, rotation, robot.geom_centers[g].tolist())
            for g, (position, rotation) in ((g, frames[robot.geom_bodies[g]]) for g in points)
        ]
        shape = q.shape[:1]
        position = [
            jnp.stack([jnp.broadcast_to(jnp.asarray(p[a], q.dtype), shape) for p in world])
            for a in range(3)
        ]  # three of [P B]
        turned = jnp.swapaxes(rotation_matrices(scene.quats), -1, -2)  # world to box

        def to_box(center, half_extents, rotation, exists):
            offset = [position[a] - center[a] for a in range(3)]
            local = [sum(rotation[r, a] * offset[a] for a in range(3)) for r in range(3)]
            beyond = [jnp.abs(local[a]) - half_extents[a] for a in range(3)]
            outside = jnp.sqrt(sum(jnp.square(jnp.maximum(b, 0.0)) for b in beyond) + 1e-12)
            inside = jnp.minimum(jnp.maximum(jnp.maximum(beyond[0], beyond[1]), beyond[2]), 0.0)
            return jnp.where(exists, outside + inside, _NOTHING_NEAR)

        def nearer(nearest, box):
            return jnp.minimum(nearest, to_box(*box)), None

        start = jnp.full(position[0].shape, _NOTHING_NEAR, q.dtype)
        boxes = (scene.centers, scene.half_extents, turned, scene.mask)
        return jax.lax.scan(nearer, start, boxes)[0].T

    return distances
