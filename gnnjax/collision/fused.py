"""The fused kernels: straight-line code, generated from a robot's constants (see `kinematics.py`).

Geoms that no joint moves (an arm's base) are not tested against obstacles: no configuration changes
the outcome. `boxes_clear` tests them, once a scene.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.kinematics import (
    WORLD,
    Frame,
    Joints,
    Vector,
    body_frames,
    dot,
    joint_terms,
    subtract,
    transform,
)
from gnnjax.arm.robot import Robot
from gnnjax.collision.exact import WORD, Placed, Touching, exact_test
from gnnjax.scene.geometry import squared_distance
from gnnjax.scene.scene import Scene, last_box, rotation_matrices

# Pairs of the arm's own geometry in one pass of the fused kernel. The compiler turns a pass into a
# single loop over the batch. It splits what exceeds 2,000 operations into functions, and where it
# fails to join them again, the loop runs several times slower.
_SELF_PAIRS_A_PASS = 120
_OPEN_AT_ONCE = 32  # configurations that spheres leave open, and are decided together
FAR = 1e6  # m; where obstacles are that do not exist


def boxes_clear(
    robot: Robot, scene: Scene, q: Float[Array, " D"], *, base_only: bool = False
) -> Bool[Array, " M"]:
    """Tells for every obstacle of a scene whether the arm is clear of it; true on padding.

    Args:
        robot: the arm.
        scene: M obstacles.
        q: the arm's configuration.
        base_only: test only the geoms that no joint moves, which `Checker` leaves out.
    """
    moved = moved_by_joint(robot)
    chosen = [g for g in range(len(moved)) if not (base_only and moved[g])]
    if not chosen:
        return jnp.ones(scene.mask.shape, bool)
    points = _points(robot, joint_terms(robot, q))

    where = [
        jnp.stack([jnp.asarray(points[g][a], q.dtype) for g in chosen])[:, None] for a in range(3)
    ]

    def seen_from_obstacle(vector: Vector) -> Vector:
        return [dot(list(to_box), vector) for to_box in turned]

    turned = jnp.moveaxis(rotation_matrices(scene.quats), 0, -1).swapaxes(0, 1)
    offset = seen_from_obstacle(subtract(where, list(scene.centers.T)))
    disc, ball = scene.radii.T
    squared = squared_distance(offset, list(scene.half_extents.T), disc)
    reach = jnp.asarray(robot.geom_radii[chosen], q.dtype)[:, None] + ball
    return jnp.all(squared > reach**2, axis=0) | ~scene.mask


def moved_by_joint(robot: Robot) -> list[bool]:
    """Whether each collision geom is moved by some joint."""
    moved: list[bool] = []
    for body in robot.bodies:
        moved.append(bool(body.joints) or (body.parent >= 0 and moved[body.parent]))
    return [b >= 0 and moved[b] for b in robot.geom_bodies.tolist()]


def _points(robot: Robot, joints: Joints, base: Frame = WORLD) -> list[Vector]:
    """Centre of every sphere, m; see `body_frames`."""
    frames = body_frames(robot, joints, base)
    points = []
    for body, center in zip(robot.geom_bodies, robot.geom_centers.tolist(), strict=True):
        position, rotation = frames[body] if body >= 0 else base
        points.append(transform(position, rotation, center))
    return points


class Levels(NamedTuple):
    """A test in two steps, of which the second is of those alone that the first leaves open.

    Both are functions `(scenes [P], owner [B], q [B D]) -> [B]`.
    """

    first: Callable[[Scene, jax.Array, jax.Array], jax.Array]  # BLOCKED, OPEN or FREE
    second: Callable[[Scene, jax.Array, jax.Array], jax.Array]  # whether it is free


BLOCKED, OPEN, FREE = 0, 1, 2


class CollisionFunctions(NamedTuple):
    """What a backend is; see `Checker`."""

    clearance: Callable[[Scene, jax.Array], jax.Array]
    collision_free: Callable[[Scene, jax.Array], jax.Array]
    collision_free_each: Callable[[Scene, jax.Array, jax.Array], jax.Array]
    levels: Levels | None  # of the last; None for an arm whose spheres leave nothing open


class _Obstacles(NamedTuple):
    """What a pass needs of M obstacles: the same for all configurations, or each its own."""

    origins: Float[Array, "M 3 *batch"]  # of the base, seen from the obstacle
    rotations: Float[Array, "M 3 3 *batch"] | None  # base to obstacle; None: none is rotated
    half_extents: Float[Array, "M 3 *batch"]
    radii: Float[Array, "M 2 *batch"]
    num: Int[Array, ""]  # passes: none after the last obstacle that exists


def _obstacles(scene: Scene, axis_aligned: bool) -> _Obstacles:
    """Of a scene, or of P scenes; then `*batch` comes first and is moved by the caller."""
    mask = scene.mask
    # Those that do not exist are far away.
    origins, rotations = -jnp.where(mask[..., None], scene.centers, FAR), None
    if not axis_aligned:
        rotations = rotation_matrices(scene.quats).swapaxes(-1, -2)
        origins = jnp.sum(rotations * origins[..., None, :], axis=-1)
    return _Obstacles(origins, rotations, scene.half_extents, scene.radii, last_box(mask))


def fused_functions(robot: Robot, axis_aligned: bool) -> CollisionFunctions:
    """Builds the functions of a `Checker` of fused kernels.

    Args:
        robot: the arm.
        axis_aligned: promise that no obstacle is rotated; the kernel then skips the rotation.
    """
    # Of spheres around the parts, and of those inside of them; the same for arms of spheres.
    is_open = bool((robot.geom_inner_radii < robot.geom_radii).any())
    # Not of those whose centre is outside of their part.
    radii = robot.geom_radii.tolist()
    inner = [x if x > 0 else None for x in robot.geom_inner_radii.tolist()]
    moving = np.flatnonzero(moved_by_joint(robot)).tolist()
    num_self = -(-len(robot.self_pairs) // _SELF_PAIRS_A_PASS)
    self_parts = np.array_split(robot.self_pairs, max(1, num_self))

    def smaller(a, b):
        # Not jnp.minimum: that must return NaN for NaN, which costs three instructions instead of
        # one. NaN configurations are refused by the joint limits.
        return jnp.where(a < b, a, b)

    def squared_distances(joints, obstacle):
        origin, rotation, half_extents, (disc, ball) = obstacle
        # Kinematics in the frame of the obstacle are less work than moving every sphere there.
        turned = WORLD[1] if rotation is None else [list(row) for row in rotation]
        points = _points(robot, joints, (list(origin), turned))
        for g in moving:
            yield g, squared_distance(points[g], list(half_extents), disc), ball

    def smallest_value(obstacles: _Obstacles, q: jax.Array, value, worth_going_on) -> jax.Array:
        """The smallest of `value(squared distance, radius, inner radius)` of all pairs."""
        joints = joint_terms(robot, q)

        # One obstacle a pass. With several, the compiler finds out what they share and the kernel
        # is a sixth faster, but it takes three times as long to compile. One array comes out, or
        # the compiler would compute all of it for each.
        def one_pass(i, smallest):
            # The barrier keeps the compiler from moving the kinematics out of the loop, which
            # would send every sphere's coordinates through memory: three times slower.
            fresh, smallest = jax.lax.optimization_barrier((joints, smallest))
            *parts, _ = obstacles  # the rotations may be None
            own = jax.tree.map(lambda x: x[i], parts)
            for g, squared, ball in squared_distances(fresh, own):
                reach = radii[g] + ball, None if inner[g] is None else inner[g] + ball
                smallest = smaller(value(squared, *reach), smallest)
            return smallest

        smallest = jnp.full(q.shape[:-1], jnp.inf, q.dtype)
        smallest = jax.lax.fori_loop(0, obstacles.num, one_pass, smallest)
        for part in self_parts:

            def self_turn(_, smallest, part=part):
                fresh, smallest = jax.lax.optimization_barrier((joints, smallest))
                points = _points(robot, fresh)
                for i, j in part:
                    offset = subtract(points[i], points[j])
                    both = inner[i], inner[j]
                    reach = radii[i] + radii[j], None if None in both else sum(both)
                    smallest = smaller(value(dot(offset, offset), *reach), smallest)
                return smallest

            # A loop of one turn or none, for the same reason as above; none where it cannot matter.
            turns = jnp.any(worth_going_on(smallest)).astype(jnp.int32)
            smallest = jax.lax.fori_loop(0, turns, self_turn, smallest)
        return smallest

    def status(obstacles: _Obstacles, q: jax.Array) -> jax.Array:
        # Squares compare like distances and need no root.
        def value(squared, reach, inner_reach):
            touching = float(OPEN if is_open else BLOCKED)
            if is_open and inner_reach is not None:
                touching = jnp.where(squared > inner_reach**2, float(OPEN), float(BLOCKED))
            return jnp.where(squared > reach**2, float(FREE), touching)

        least = smallest_value(obstacles, q, value, lambda least: least > BLOCKED)
        return jnp.where(least < FREE, least, float(FREE))  # infinite where there is nothing

    # Of the pairs of `exact_test`: which bit of which word they are.
    part_of, pair_of = robot.geom_parts.tolist(), _part_pairs(robot)
    num_words = -(-len(robot.parts) // WORD), -(-len(robot.part_pairs) // WORD)

    def touching(obstacles: _Obstacles, q: jax.Array) -> Touching:
        joints = joint_terms(robot, q)

        def one_pass(i, words):
            fresh, words = jax.lax.optimization_barrier((joints, words))
            *parts, _ = obstacles
            own = jax.tree.map(lambda x: x[i], parts)
            found = [jnp.zeros(len(q), jnp.uint32)] * num_words[0]
            for g, squared, ball in squared_distances(fresh, own):
                word, bit = divmod(part_of[g], WORD)
                hit = squared <= (radii[g] + ball) ** 2
                found[word] |= jnp.where(hit, jnp.uint32(1 << bit), jnp.uint32(0))
            return words.at[i].set(jnp.stack(found))

        nothing = jnp.zeros((len(obstacles.origins), num_words[0], len(q)), jnp.uint32)
        parts = jax.lax.fori_loop(0, obstacles.num, one_pass, nothing)
        pairs = [jnp.zeros(len(q), jnp.uint32)] * num_words[1]
        for part in self_parts if num_words[1] else ():

            def self_turn(_, words, part=part):
                fresh, words = jax.lax.optimization_barrier((joints, words))
                points, words = _points(robot, fresh), list(words)
                for i, j in part:
                    word, bit = divmod(pair_of[part_of[i], part_of[j]], WORD)
                    offset = subtract(points[i], points[j])
                    hit = dot(offset, offset) <= (radii[i] + radii[j]) ** 2
                    words[word] |= jnp.where(hit, jnp.uint32(1 << bit), jnp.uint32(0))
                return words

            # One turn, which the compiler must not know.
            pairs = jax.lax.fori_loop(0, jnp.minimum(obstacles.num + 1, 1), self_turn, pairs)
        stacked = jnp.stack(pairs) if pairs else jnp.zeros((0, len(q)), jnp.uint32)
        return Touching(parts, stacked)

    # Nobody asks it of an arm whose spheres leave nothing open.
    is_free_exactly = exact_test(robot) if is_open else None

    def decide(obstacles: _Obstacles, q: jax.Array) -> jax.Array:
        """Whether configurations with obstacles of their own are free, by their parts."""
        assert is_free_exactly is not None
        *parts, _ = obstacles
        return is_free_exactly(Placed(*parts), touching(obstacles, q), q)

    def of_each(obstacles: _Obstacles, rows: jax.Array) -> _Obstacles:
        """The obstacles of some configurations, each its own, and all of them rotated."""
        origins, rotations, extents, radii, num = obstacles
        if rotations is None:
            rotations = jnp.broadcast_to(jnp.eye(3), (len(origins), 3, 3))

        def own(x: jax.Array, axes: int) -> jax.Array:
            if x.ndim == axes:
                return jnp.broadcast_to(x[..., None], (*x.shape, len(rows)))
            return x[..., rows]

        return _Obstacles(own(origins, 2), own(rotations, 3), own(extents, 2), own(radii, 2), num)

    def is_free(obstacles: _Obstacles, q: jax.Array) -> jax.Array:
        first = status(obstacles, q)
        if not is_open:
            return first == FREE

        def some_left(state):
            return jnp.any(state[0])

        def decide_some(state):
            left, free = state
            (rows,) = jnp.nonzero(left, size=_OPEN_AT_ONCE, fill_value=len(q))
            chosen = jnp.minimum(rows, len(q) - 1)
            found = decide(of_each(obstacles, chosen), q[chosen])
            return left.at[rows].set(False, mode="drop"), free.at[rows].set(found, mode="drop")

        state = first == OPEN, first == FREE
        return jax.lax.while_loop(some_left, decide_some, state)[1]

    def clearance(scene: Scene, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        def gap(squared, reach, _):
            return jnp.sqrt(squared) - reach

        obstacles = _obstacles(scene, axis_aligned)
        return smallest_value(obstacles, q, gap, lambda gaps: gaps == gaps)

    def collision_free(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        return is_free(_obstacles(scene, axis_aligned), nodes)

    def obstacles_of_each(scenes: Scene, owner: jax.Array) -> _Obstacles:
        own = _obstacles(jax.tree.map(lambda x: x[owner], scenes), axis_aligned)
        # One array a component, as everything else in a pass.
        moved = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), own._replace(num=None))
        return moved._replace(num=own.num)

    def collision_free_each(
        scenes: Scene, owner: Int[Array, " B"], nodes: Float[Array, "B D"]
    ) -> Bool[Array, " B"]:
        return is_free(obstacles_of_each(scenes, owner), nodes)

    def first_level(
        scenes: Scene, owner: Int[Array, " B"], nodes: Float[Array, "B D"]
    ) -> Int[Array, " B"]:
        return status(obstacles_of_each(scenes, owner), nodes).astype(jnp.int8)

    def second_level(
        scenes: Scene, owner: Int[Array, " B"], nodes: Float[Array, "B D"]
    ) -> Bool[Array, " B"]:
        obstacles = obstacles_of_each(scenes, owner)
        return decide(of_each(obstacles, jnp.arange(len(nodes))), nodes)

    # Traced once a shape, however often a function that is compiled around it asks.
    return CollisionFunctions(
        clearance,
        jax.jit(collision_free),
        jax.jit(collision_free_each),
        Levels(first_level, second_level) if is_open else None,
    )


def _part_pairs(robot: Robot) -> dict[tuple[int, int], int]:
    """Of two parts, in either order, their number in `Robot.part_pairs`."""
    found = {}
    for number, (first, second) in enumerate(robot.part_pairs.tolist()):
        found[first, second] = found[second, first] = number
    return found
