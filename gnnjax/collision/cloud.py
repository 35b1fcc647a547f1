"""Tests against the clouds of scenes, beside those against their other obstacles.

Here the arm is the spheres around its parts, whose grid look-ups cost no more for a million points
than for one. What they leave open counts as blocked: no second level decides it by the parts.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from gnnjax.arm.kinematics import body_frames, joint_terms, transform
from gnnjax.arm.robot import Robot
from gnnjax.collision.fused import CollisionFunctions, Levels
from gnnjax.collision.spheres import BLOCKED, moved_by_joint
from gnnjax.scene.cloud import Cloud
from gnnjax.scene.lookup import Lookup, lookup, squared_distance_to
from gnnjax.scene.scene import Scene

_SPHERES_A_PASS = 8
# What single precision rounds off: of positions, m, and of squared distances, as a share.
_ROUNDING, _SHARE = 1e-5, 1e-5


class _Placed(NamedTuple):
    """Scenes `[P]`, as `check_each` wants them."""

    others: Any  # what the backend has made of all that is no cloud
    clouds: Cloud | None


def with_clouds(robot: Robot, functions: CollisionFunctions) -> CollisionFunctions:
    """The functions of a backend that knows no clouds, for scenes with and without.

    For scenes without, nothing else is compiled than before.

    Args:
        robot: the arm.
        functions: of a backend.
    """
    least = least_of_spheres(robot)

    def clear(grid: Lookup, q: jax.Array) -> jax.Array:
        def beyond(squared: jax.Array, reach: jax.Array) -> jax.Array:
            reach = reach + _ROUNDING
            return squared * (1.0 - _SHARE) - reach * reach

        return least(grid, q, beyond) > 0.0

    def clearance(scene: Scene, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        def gap(squared: jax.Array, reach: jax.Array) -> jax.Array:
            return jnp.sqrt(jnp.where(squared > 0.0, squared, 0.0)) - reach

        found = functions.clearance(scene._replace(cloud=None), q)
        if scene.cloud is None:
            return found
        return jnp.minimum(found, least(lookup(scene.cloud), q, gap))

    def collision_free(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        free = functions.collision_free(scene._replace(cloud=None), nodes)
        return free if scene.cloud is None else free & clear(lookup(scene.cloud), nodes)

    def place(scenes: Scene) -> _Placed:
        return _Placed(functions.place(scenes._replace(cloud=None)), scenes.cloud)

    def collision_free_each(
        placed: _Placed, owner: Int[Array, " G"], nodes: Float[Array, "G T D"]
    ) -> Bool[Array, "G T"]:
        free = functions.collision_free_each(placed.others, owner, nodes)
        if placed.clouds is None:
            return free
        return free & clear(lookup(placed.clouds, owner[:, None]), nodes)

    levels = functions.levels
    if levels is not None:
        first, second = levels

        def first_level(
            placed: _Placed, owner: Int[Array, " G"], nodes: Float[Array, "G T D"]
        ) -> UInt[Array, "G T"]:
            found = first(placed.others, owner, nodes)
            if placed.clouds is None:
                return found
            free = clear(lookup(placed.clouds, owner[:, None]), nodes)
            return found | jnp.where(free, jnp.uint32(0), BLOCKED)

        def clear_of_obstacles(placed: _Placed, *asked: jax.Array) -> jax.Array:
            # Of what the first level leaves open, which is clear of the clouds.
            return second.clear_of_obstacles(placed.others, *asked)

        levels = Levels(first_level, second._replace(clear_of_obstacles=clear_of_obstacles))
    return CollisionFunctions(clearance, collision_free, place, collision_free_each, levels)


def least_of_spheres(
    robot: Robot,
) -> Callable[[Lookup, jax.Array, Callable[[jax.Array, jax.Array], jax.Array]], jax.Array]:
    """Makes the function `(grid, q [*batch D], value) -> [*batch]`.

    It is the least of `value(squared distance, radius)` of the spheres around what moves of the
    arm, the cloud's radius added to theirs.
    """
    moving: list[int] = np.flatnonzero(moved_by_joint(robot)).tolist()
    bodies: list[int] = robot.geom_bodies.tolist()
    radii: list[float] = robot.geom_radii.tolist()
    centers = robot.geom_centers.tolist()

    def least(
        grid: Lookup,
        q: Float[Array, "*batch D"],
        value: Callable[[jax.Array, jax.Array], jax.Array],
    ) -> Float[Array, "*batch"]:
        joints = joint_terms(robot, q)
        smallest = jnp.full(q.shape[:-1], jnp.inf, q.dtype)
        for begin in range(0, len(moving), _SPHERES_A_PASS):
            chosen = moving[begin : begin + _SPHERES_A_PASS]

            def look(_, smallest, chosen=chosen):
                # As in the other kernels: kinematics anew in each pass, or the positions of all
                # spheres would go through memory.
                fresh, smallest = jax.lax.optimization_barrier((joints, smallest))
                frames = body_frames(robot, fresh)
                for g in chosen:
                    position, rotation = frames[bodies[g]]
                    point = transform(position, rotation, centers[g])
                    found = value(squared_distance_to(grid, point), radii[g] + grid.radius)
                    smallest = jnp.where(found < smallest, found, smallest)
                return smallest

            smallest = jax.lax.fori_loop(0, 1, look, smallest)
        return smallest

    return least
