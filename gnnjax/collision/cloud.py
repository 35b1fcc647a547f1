"""Tests against the clouds of scenes, beside those against their other obstacles.

First the arm is the spheres around its parts, whose grid look-ups cost no more for a million points
than for one. What they leave open is decided by the parts and the points themselves (`points.py`),
where the backend has a second level for other obstacles, too, and counts as blocked where not.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from gnnjax.arm.kinematics import body_frames, joint_terms, transform_point
from gnnjax.arm.robot import Robot
from gnnjax.collision.exact import WORD, bits_of
from gnnjax.collision.levels import BLOCKED, CLOUD, CollisionFunctions, Levels
from gnnjax.collision.points import Leaves, clear_of_points, leaves_of
from gnnjax.collision.spheres import moved_by_joint
from gnnjax.scene.cloud import Cloud
from gnnjax.scene.lookup import Corners, corners_around, lookup
from gnnjax.scene.scene import Scene

_SPHERES_A_PASS = 8
_OPEN_AT_ONCE = 32  # configurations that look-ups leave open, and are decided together
# What single precision rounds off: of positions, m, and of squared distances, as a share.
_ROUNDING, _SHARE = 1e-5, 1e-5


class _Placed(NamedTuple):
    """Scenes `[P]`, as `check_each` wants them."""

    others: Any  # what the backend has made of all that is no cloud
    clouds: Cloud | None  # without their points
    leaves: Leaves | None  # these; None where the first level is all


def without_leaves(placed: _Placed) -> _Placed:
    """What all but `clear_of_cloud` needs; of the same shape for clouds of any number of points."""
    return placed._replace(leaves=None)


def with_clouds(robot: Robot, functions: CollisionFunctions) -> CollisionFunctions:
    """The functions of a backend that knows no clouds, for scenes with and without.

    For scenes without, nothing else is compiled than before.

    Args:
        robot: the arm.
        functions: of a backend.
    """
    over_spheres = over_moving_spheres(robot)
    levels, num_words = functions.levels, -(-len(robot.parts) // WORD)
    clear_of_parts = None if levels is None else clear_of_points(robot)

    def touched(
        clouds: Cloud, owner: Int[Array, "..."], q: Float[Array, "*batch D"], *, deep: bool
    ) -> UInt[Array, " W *batch"]:
        """Bit p % WORD of word p // WORD: whether spheres of part p are not clear.

        Where it is to be told what is `deep`, words from `BLOCKED` on: those inside of it touch.
        """

        def look(words: list, g: int, corners: Corners, reach: jax.Array) -> list:
            word, bit = divmod(int(robot.sphere_parts[g]), WORD)
            more = reach + _ROUNDING
            gap = corners.at_least() * (1.0 - _SHARE) - more * more
            # So that NaN is not clear.
            hit = jnp.where(gap > 0.0, jnp.uint32(0), jnp.uint32(1 << bit))
            if deep and robot.sphere_inner_radii[g] > 0:  # whose centre is inside of its part
                less = reach - float(robot.sphere_radii[g] - robot.sphere_inner_radii[g])
                hit = hit | jnp.where(corners.are_within(less), BLOCKED, jnp.uint32(0))
            return [x | hit if i == word else x for i, x in enumerate(words)]

        nothing = [jnp.zeros(q.shape[:-1], jnp.uint32)] * num_words
        return jnp.stack(over_spheres(clouds, owner, q, nothing, look))

    def clearance(scene: Scene, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        def least(smallest: jax.Array, _: int, corners: Corners, reach: jax.Array) -> jax.Array:
            squared = corners.at_least()
            found = jnp.sqrt(jnp.where(squared > 0.0, squared, 0.0)) - reach
            return jnp.where(found < smallest, found, smallest)

        found = functions.clearance(scene._replace(cloud=None), q)
        if scene.cloud is None:
            return found
        return over_spheres(scene.cloud, None, q, found, least)

    def place(scenes: Scene) -> _Placed:
        others = functions.place(scenes._replace(cloud=None))
        if scenes.cloud is None:
            return _Placed(others, None, None)
        leaves = None if levels is None else leaves_of(jax.tree.map(jnp.asarray, scenes.cloud))
        points = scenes.cloud.points[..., :0, :]
        return _Placed(others, scenes.cloud._replace(points=points), leaves)

    def clear_of_cloud(
        placed: _Placed,
        owner: Int[Array, " N"],
        q: Float[Array, "N D"],
        wanted: Bool[Array, " N"],
    ) -> Bool[Array, " N"]:
        clouds, leaves = placed.clouds, placed.leaves
        if clouds is None:
            return jnp.ones(len(q), bool)
        if leaves is None or clear_of_parts is None:
            return ~wanted

        words = touched(clouds, owner, q, deep=False)
        touching = bits_of(words, len(robot.parts)) & wanted
        return clear_of_parts(leaves, clouds.radius, owner, q, touching)

    def decided(
        placed: _Placed, owner: Int[Array, " G"], q: Float[Array, "G T D"], free: Bool[Array, "G T"]
    ) -> Bool[Array, "G T"]:
        """What is clear of the clouds of all that is `free` of others."""
        if placed.clouds is None:
            return free
        if placed.leaves is None or clear_of_parts is None:
            words = touched(placed.clouds, owner[:, None], q, deep=False)
            return free & (words == 0).all(axis=0)
        words = touched(placed.clouds, owner[:, None], q, deep=True)
        free, by_grid = free & (words < BLOCKED).all(axis=0), (words == 0).all(axis=0)
        num, each, configurations = free.size, q.shape[1], q.reshape(-1, q.shape[-1])
        words, radius = words.reshape(len(words), -1), placed.clouds.radius
        (queue,) = jnp.nonzero((free & ~by_grid).reshape(-1), size=num, fill_value=num)
        queue = jnp.pad(queue, (0, _OPEN_AT_ONCE), constant_values=num)

        def decide_some(state, leaves=placed.leaves, clear_of_parts=clear_of_parts):
            begin, free = state
            rows = jax.lax.dynamic_slice(queue, (begin,), (_OPEN_AT_ONCE,))
            at = jnp.minimum(rows, num - 1)
            touching = bits_of(words[:, at], len(robot.parts)) & (rows < num)
            found = clear_of_parts(leaves, radius, owner[at // each], configurations[at], touching)
            return begin + _OPEN_AT_ONCE, free.at[rows].set(found, mode="drop")

        state = jnp.int32(0), (free & by_grid).reshape(-1)
        num_open = (queue < num).sum()
        found = jax.lax.while_loop(lambda state: state[0] < num_open, decide_some, state)[1]
        return found.reshape(free.shape)

    def collision_free(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        free = functions.collision_free(scene._replace(cloud=None), nodes)
        if scene.cloud is None:
            return free
        nodes = jnp.asarray(nodes)  # rows are taken out by what only a compiled loop knows
        placed = place(jax.tree.map(lambda x: jnp.asarray(x)[None], scene))
        return decided(placed, jnp.zeros(1, jnp.int32), nodes[None], free[None])[0]

    def collision_free_each(
        placed: _Placed, owner: Int[Array, " G"], nodes: Float[Array, "G T D"]
    ) -> Bool[Array, "G T"]:
        free = functions.collision_free_each(placed.others, owner, nodes)
        return decided(placed, owner, nodes, free)

    if levels is None:
        return CollisionFunctions(clearance, collision_free, place, collision_free_each, None)
    first, second = levels

    def first_level(
        placed: _Placed, owner: Int[Array, " G"], nodes: Float[Array, "G T D"]
    ) -> UInt[Array, "G T"]:
        found = first(placed.others, owner, nodes)
        if placed.clouds is None:
            return found
        words = touched(placed.clouds, owner[:, None], nodes, deep=True)
        blocked, free = (words >= BLOCKED).any(axis=0), (words == 0).all(axis=0)
        found = jnp.where(blocked, BLOCKED, found)
        return jnp.where(free | (found >= BLOCKED), found, found | CLOUD)

    def clear_of_obstacles(placed: _Placed, *asked: jax.Array) -> jax.Array:
        return second.clear_of_obstacles(placed.others, *asked)

    both = Levels(
        first_level,
        second._replace(clear_of_obstacles=clear_of_obstacles, clear_of_cloud=clear_of_cloud),
    )
    return CollisionFunctions(clearance, collision_free, place, collision_free_each, both)


def over_moving_spheres(robot: Robot) -> Callable[..., Any]:
    """Makes the function `(cloud, owner, q [*batch D], start, step) -> value` that takes a value
    through the spheres around what moves of the arm; cloud and owner are those of `lookup`.

    The step is `(value, sphere, corners, reach [*batch]) -> value`: what the grid tells of the
    sphere's centre, and the sum of its radius and that of the balls.
    """
    moving: list[int] = np.flatnonzero(moved_by_joint(robot)).tolist()
    bodies: list[int] = robot.sphere_bodies.tolist()
    radii: list[float] = robot.sphere_radii.tolist()
    centers = robot.sphere_centers.tolist()

    def over(
        cloud: Cloud,
        owner: Int[Array, "..."] | None,
        q: Float[Array, "*batch D"],
        start: Any,
        step: Callable[..., Any],
    ) -> Any:
        grid, joints, value = lookup(cloud, owner), joint_terms(robot, q), start
        # One turn or none, which the compiler must not know: it would compute all of a pass again
        # for whoever asks for its outcome.
        turns = jnp.any(cloud.num > 0).astype(jnp.int32)
        for begin in range(0, len(moving), _SPHERES_A_PASS):
            chosen = moving[begin : begin + _SPHERES_A_PASS]

            def look(_, value, chosen=chosen):
                # As in the other kernels: kinematics anew in each pass, or the positions of all
                # spheres would go through memory.
                fresh, value = jax.lax.optimization_barrier((joints, value))
                frames = body_frames(robot, fresh)
                for g in chosen:
                    position, rotation = frames[bodies[g]]
                    point = transform_point(position, rotation, centers[g])
                    value = step(value, g, corners_around(grid, point), radii[g] + grid.radius)
                return value

            value = jax.lax.fori_loop(0, turns, look, value)
        return value

    return over
