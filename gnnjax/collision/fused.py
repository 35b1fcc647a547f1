"""The fused kernels: what the arm's spheres prove, and the rest by its parts.

Geoms that no joint moves (an arm's base) are not tested against obstacles: no configuration changes
the outcome. `obstacles_clear` tests them, once a scene.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from gnnjax.arm.kinematics import Vector, dot, joint_terms, subtract
from gnnjax.arm.robot import Robot
from gnnjax.collision.contact_maps import contact_maps
from gnnjax.collision.exact import part_tests
from gnnjax.collision.levels import (
    BLOCKED,
    ITSELF,
    OBSTACLE_BITS,
    CollisionFunctions,
    Levels,
    are_free,
)
from gnnjax.collision.placed import Placed, place
from gnnjax.collision.spheres import PairTable, Passes, moved_by_joint, placed_spheres
from gnnjax.scene.geometry import squared_distance
from gnnjax.scene.lookup import lookup, squared_distance_to
from gnnjax.scene.scene import Scene, rotation_matrices


def obstacles_clear(
    robot: Robot, scene: Scene, q: Float[Array, " D"], *, base_only: bool = False
) -> Bool[Array, " M"]:
    """Tells for every obstacle of a scene whether the arm is clear of it; true on padding.

    One more tells of the scene's cloud, if it has one.

    Args:
        robot: the arm.
        scene: M obstacles.
        q: the arm's configuration.
        base_only: test only the geoms that no joint moves, which `Checker` leaves out.
    """
    moved = moved_by_joint(robot)
    chosen = [g for g in range(len(moved)) if not (base_only and moved[g])]
    if not chosen:
        return jnp.ones(len(scene.mask) + (scene.cloud is not None), bool)
    points = placed_spheres(robot, joint_terms(robot, q))

    where = [
        jnp.stack([jnp.asarray(points[g][a], q.dtype) for g in chosen])[:, None] for a in range(3)
    ]

    def seen_from_obstacle(vector: Vector) -> Vector:
        return [dot(list(to_box), vector) for to_box in turned]

    turned = jnp.moveaxis(rotation_matrices(scene.quats), 0, -1).swapaxes(0, 1)
    offset = seen_from_obstacle(subtract(where, list(scene.centers.T)))
    disc, ball = scene.radii.T
    squared = squared_distance(offset, list(scene.half_extents.T), disc)
    reach = jnp.asarray(robot.sphere_radii[chosen], q.dtype)[:, None] + ball
    apart = squared > reach**2
    if scene.allowed is not None:
        # Of the world, whose number is -1, nothing is meant.
        meant = jnp.pad(scene.allowed.pairs, ((0, 0), (0, 1)))
        apart |= meant[:, robot.sphere_bodies[chosen]].T
    found = jnp.all(apart, axis=0) | ~scene.mask
    if scene.cloud is None:
        return found
    squared = squared_distance_to(lookup(scene.cloud), [x[:, 0] for x in where])
    reach = jnp.asarray(robot.sphere_radii[chosen], q.dtype) + scene.cloud.radius
    return jnp.append(found, jnp.all(squared > reach**2))


def fused_functions(robot: Robot, axis_aligned: bool) -> CollisionFunctions:
    """Builds the functions of a `Checker` of fused kernels.

    Args:
        robot: the arm.
        axis_aligned: promise that no obstacle is rotated; the kernel then skips the rotation.
    """
    # Of spheres around the parts, and of those inside of them; the same for arms of spheres.
    is_open = bool((robot.sphere_inner_radii < robot.sphere_radii).any())
    # Not of those whose centre is outside of their part.
    radii = robot.sphere_radii.tolist()
    inner = [x if x > 0 else None for x in robot.sphere_inner_radii.tolist()]
    passes = Passes(robot)
    # Spheres tell nothing of parts that never touch, or of which a map says all.
    maps = contact_maps(robot) if is_open else None
    unmapped = passes if maps is None else Passes(robot, maps.pairs)
    beside = None if maps is None else Passes(robot, maps.pairs_beside)

    def first(
        placed: Placed, owner: Int[Array, " G"], q: Float[Array, "G T D"]
    ) -> UInt[Array, "G T"]:
        def found(squared_and_reach, bit, word):
            """Squares compare like distances and need no root."""
            touching = blocked = False
            for squared, reach, inner_reach in squared_and_reach:
                touching |= ~(squared > reach**2)  # NaN touches
                if inner_reach is not None:
                    blocked |= ~(squared > inner_reach**2)
            if not is_open:
                touching, blocked = False, touching
            bits = jnp.where(touching, bit, jnp.uint32(0))
            return word | jnp.where(blocked, BLOCKED, bits)

        def with_obstacle(word, i, distances):
            bit = jnp.uint32(1) << (i % OBSTACLE_BITS).astype(jnp.uint32)
            pairs = (
                (squared, radii[g] + ball, None if inner[g] is None else inner[g] + ball)
                for g, squared, ball in distances
            )
            return found(pairs, bit, word)

        def with_itself(word, distances):
            pairs = (
                (
                    squared,
                    radii[i] + radii[j],
                    None if None in (inner[i], inner[j]) else inner[i] + inner[j],
                )
                for i, j, squared in distances
            )
            return found(pairs, ITSELF, word)

        def of_itself(word, passes):
            squares = None if passes.table is None else _squares(robot, passes.table)

            def with_row(word, number, squared):
                assert squares is not None
                outer, inner = (jnp.asarray(x)[number][:, None, None] for x in squares)
                touches = jnp.any(~(squared > outer), axis=0)
                if not is_open:
                    return jnp.where(touches, word | BLOCKED, word)
                proven = jnp.any(~(squared > inner), axis=0)
                return word | jnp.where(proven, BLOCKED, jnp.where(touches, ITSELF, jnp.uint32(0)))

            def worth_going_on(word, gap):
                return (word < BLOCKED) & ~(gap > 0)

            return passes.over_itself(joints, word, with_itself, with_row, worth_going_on)

        joints, nothing = joint_terms(robot, q), jnp.zeros(q.shape[:-1], jnp.uint32)
        word = passes.over_obstacles(joints, placed, owner, nothing, with_obstacle)
        if maps is None:
            return of_itself(word, unmapped)
        word |= maps.words(maps.alone, q)
        word = of_itself(word, unmapped)
        if not maps.beside:
            return word
        # Maps and spheres may both prove that parts are clear of each other.
        told = of_itself(word & BLOCKED, beside)
        left = jnp.where(told & ITSELF > 0, maps.words(maps.beside, q), jnp.uint32(0))
        return word | told & BLOCKED | left

    # Nobody asks it of an arm whose spheres leave nothing open.
    levels = None
    if maps is not None:
        asked = np.concatenate([maps.pairs, maps.pairs_beside])
        levels = Levels(first, part_tests(robot, Passes(robot, asked), maps))

    def is_free(
        placed: Placed, owner: Int[Array, " G"], q: Float[Array, "G T D"]
    ) -> Bool[Array, "G T"]:
        if levels is None:
            return first(placed, owner, q) == 0
        return are_free(levels, placed, owner, q)

    def placed_alone(scene: Scene) -> tuple[Placed, jax.Array]:
        return place(jax.tree.map(lambda x: x[None], scene), axis_aligned), jnp.zeros(1, jnp.int32)

    def clearance(scene: Scene, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        # Not jnp.minimum: that must return NaN for NaN, which costs three instructions instead of
        # one. NaN configurations are refused by the joint limits.
        def smallest(value, gaps):
            for gap in gaps:
                value = jnp.where(gap < value, gap, value)
            return value

        def with_obstacle(value, _, distances):
            return smallest(value, (jnp.sqrt(x) - radii[g] - ball for g, x, ball in distances))

        def with_itself(value, distances):
            return smallest(value, (jnp.sqrt(x) - radii[i] - radii[j] for i, j, x in distances))

        def with_row(value, number, squared):
            reach = jnp.sqrt(jnp.asarray(outer_squares)[number])[:, None, None]
            return smallest(value, jnp.sqrt(squared) - reach)

        outer_squares = None if passes.table is None else passes.table.squares
        flat = q.reshape(1, -1, q.shape[-1])
        joints, start = joint_terms(robot, flat), jnp.full(flat.shape[:-1], jnp.inf, q.dtype)
        found = passes.over_obstacles(joints, *placed_alone(scene), start, with_obstacle)
        found = passes.over_itself(joints, found, with_itself, with_row, lambda x, gap: ~(gap > x))
        return found.reshape(q.shape[:-1])

    def collision_free(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        return is_free(*placed_alone(scene), nodes[None])[0]

    # Traced once a shape, however often a function that is compiled around it asks.
    return CollisionFunctions(
        clearance,
        jax.jit(collision_free),
        lambda scenes: place(scenes, axis_aligned),
        jax.jit(is_free),
        levels,
    )


def _squares(robot: Robot, table: PairTable) -> tuple[np.ndarray, np.ndarray]:
    """Of pairs of spheres around parts and of those inside of them, the squares of the distances at
    which they touch, m^2; -1, which nothing is closer than, where there is none inside."""
    inside = robot.sphere_inner_radii[table.pairs]
    inner = np.where((inside > 0).all(axis=-1), inside.sum(axis=-1) ** 2, -1)
    return table.squares, inner.astype(np.float32)
