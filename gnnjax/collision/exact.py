"""Configurations that spheres leave open, decided by the arm's parts themselves.

Spheres around a part that touch something prove nothing, and spheres inside of it that touch
nothing neither. For what lies between, this module finds the pairs of a part and an obstacle, or of
two parts, whose spheres touch, and has each tested as convex bodies (`convex.py`), some at a time,
until one is found in contact or all are apart.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from gnnjax.arm.hulls import simpler_hulls
from gnnjax.arm.kinematics import Joints, joint_terms
from gnnjax.arm.robot import Robot
from gnnjax.arm.transforms import behind, compose_each, transform_of
from gnnjax.collision import convex
from gnnjax.collision.contact_maps import ContactMaps
from gnnjax.collision.placed import Obstacle, Placed
from gnnjax.collision.spheres import Passes

WORD = 31  # bits that tell of parts; above them there is room for `BLOCKED`


def hulls_of(robot: Robot) -> convex.Parts:
    """The arm's parts, with few vertices each, standing out by `SIMPLER` at most."""
    return jax.device_put(convex.Parts(*simpler_hulls(robot)))


class PartTests(NamedTuple):
    """Whether the arm's parts are in contact, of what its spheres leave open.

    `clear_of_obstacles(placed, owner [N], number [N], q [N D], wanted [N]) -> [N]`, each of one
    obstacle, by its number.
    `clear_of_itself(q [N D], wanted [N]) -> [N]`.
    `clear_of_cloud(placed, owner [N], q [N D], wanted [N]) -> [N]`.
    All are true where it is not wanted.
    """

    clear_of_obstacles: Callable[[Placed, jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]
    clear_of_itself: Callable[[jax.Array, jax.Array], jax.Array]
    clear_of_cloud: Callable[[Any, jax.Array, jax.Array, jax.Array], jax.Array] | None = None


def part_tests(robot: Robot, passes: Passes, maps: ContactMaps) -> PartTests:
    """Makes the functions of an arm.

    Args:
        robot: the arm.
        passes: over the pairs of its spheres that maps leave to be looked at.
        maps: of its parts.
    """
    hulls = hulls_of(robot)
    # The world's frame comes last.
    bodies = jax.device_put(np.array([part.body for part in robot.parts], np.int32))
    couples = jax.device_put(robot.part_pairs.T.astype(np.int32))
    radii, part_of, pair_of = (
        robot.sphere_radii.tolist(),
        robot.sphere_parts.tolist(),
        _pairs(robot),
    )

    def touching(
        obstacle: Obstacle, q: Float[Array, "N D"], turns: jax.Array
    ) -> UInt[Array, "W N"]:
        """Bit p % WORD of word p // WORD: spheres of part p touch the obstacle."""

        joints = joint_terms(robot, q)
        words = [jnp.zeros(len(q), jnp.uint32)] * -(-len(bodies) // WORD)

        def hits(joints: Joints) -> Iterator[tuple[int, jax.Array]]:
            for g, squared, ball in passes.to_obstacle(joints, obstacle):
                yield part_of[g], ~(squared > (radii[g] + ball) ** 2)

        return jnp.stack(_with_bits(words, hits, joints, turns))

    def touching_itself(q: Float[Array, "C D"], wanted: Bool[Array, " C"]) -> Bool[Array, "U C"]:
        """Whether spheres and maps leave it open that the two of `Robot.part_pairs[u]` touch, where
        it is wanted."""
        spheres_touch = in_code if passes.table is None else in_table
        return maps.not_clear(spheres_touch(joint_terms(robot, q), wanted), q) & wanted

    def in_code(joints: Joints, wanted: Bool[Array, " C"]) -> Bool[Array, "U C"]:
        words = [jnp.zeros(len(wanted), jnp.uint32)] * -(-couples.shape[1] // WORD)
        turns = jnp.any(wanted).astype(jnp.int32)
        for pairs in passes.self_pairs:

            def hits(joints: Joints, pairs=pairs) -> Iterator[tuple[int, jax.Array]]:
                for i, j, squared in passes.to_itself(joints, pairs):
                    both = pair_of[part_of[i], part_of[j]]
                    yield both, ~(squared > (radii[i] + radii[j]) ** 2)

            words = _with_bits(words, hits, joints, turns)
        return bits_of(jnp.stack(words), couples.shape[1])

    def in_table(joints: Joints, wanted: Bool[Array, " C"]) -> Bool[Array, "U C"]:
        assert passes.table is not None
        pairs, squares = passes.table.pairs.tolist(), jnp.asarray(passes.table.squares)
        number_of = jnp.asarray([[pair_of[part_of[i], part_of[j]] for i, j in x] for x in pairs])

        def fold(found: jax.Array, row: jax.Array, squared: jax.Array) -> jax.Array:
            return found.at[number_of[row]].max(~(squared > squares[row][:, None]) & wanted)

        nothing = jnp.zeros((couples.shape[1], len(wanted)), bool)
        return passes.over_table(joints, nothing, fold, lambda _, gap: wanted & ~(gap > 0))

    def clear_of_obstacles(
        placed: Placed,
        owner: Int[Array, " N"],
        number: Int[Array, " N"],
        q: Float[Array, "N D"],
        wanted: Bool[Array, " N"],
    ) -> Bool[Array, " N"]:
        parts = jax.tree.map(
            lambda x: jnp.moveaxis(x[number, ..., owner], 0, -1), tuple(placed)[:-1]
        )
        obstacle, frames = Obstacle(*parts), part_frames(robot, q)
        turned = obstacle.rotation
        if turned is None:
            turned = jnp.broadcast_to(jnp.eye(3)[..., None], (3, 3, len(q)))

        def gaps(part: jax.Array, lane: jax.Array) -> jax.Array:
            position, rotation = _seen(turned[..., lane], *frames[bodies[part], lane])
            position = position + obstacle.origin[:, lane]
            disc, ball = obstacle.radii[:, lane]
            shapes = convex.Sums(obstacle.half_extents[:, lane], disc, ball)
            return convex.separate_obstacles(hulls, part, position, rotation, shapes).gaps

        words = touching(obstacle, q, jnp.any(wanted).astype(jnp.int32))
        return test_pairs(bits_of(words, len(bodies)) & wanted, gaps)

    def clear_of_itself(q: Float[Array, "N D"], wanted: Bool[Array, " N"]) -> Bool[Array, " N"]:
        frames = part_frames(robot, q)

        def gaps(pair: jax.Array, lane: jax.Array) -> jax.Array:
            first, second = couples[:, pair]
            origin, axes = frames[bodies[first], lane]
            base, seen_from = frames[bodies[second], lane]
            turned = jnp.swapaxes(seen_from, 0, 1)
            position, rotation = _seen(turned, origin - base, axes)
            nothing = jnp.zeros(len(pair))
            return convex.separate_parts(
                hulls, first, position, rotation, second, position, nothing
            ).gaps

        if not couples.size:
            return jnp.ones(len(q), bool)
        return test_pairs(touching_itself(q, wanted), gaps)

    return PartTests(clear_of_obstacles, clear_of_itself)


def _with_bits(
    words: list[jax.Array],
    hits: Callable[[Joints], Iterator[tuple[int, jax.Array]]],
    joints: Joints,
    turns: jax.Array,
) -> list[jax.Array]:
    """Words with the bits of those that hits name, in one turn of a loop, or as they are in none.

    The compiler must not know which: outside of a loop it computes every sphere's distance apart,
    each from the base on, and bits of parts from those.
    """

    def turn(_, words: list[jax.Array]) -> list[jax.Array]:
        fresh, words = jax.lax.optimization_barrier((joints, words))
        words = list(words)
        for number, hit in hits(fresh):
            word, bit = divmod(number, WORD)
            words[word] |= jnp.where(hit, jnp.uint32(1 << bit), jnp.uint32(0))
        return words

    return jax.lax.fori_loop(0, turns, turn, words)


def _pairs(robot: Robot) -> dict[tuple[int, int], int]:
    """Of two parts, in either order, their number in `Robot.part_pairs`."""
    found = {}
    for number, (first, second) in enumerate(robot.part_pairs.tolist()):
        found[first, second] = found[second, first] = number
    return found


class _Frames:
    """Where bodies are at C configurations; `frames[body, at]` are `[3 N]` and `[3 3 N]`."""

    def __init__(self, origins: jax.Array, axes: jax.Array):
        self.origins, self.axes = origins, axes  # [L 3 C], [L 3 3 C]

    def __getitem__(self, where: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        body, at = where
        return self.origins[body, :, at].T, jnp.moveaxis(self.axes[body, :, :, at], 0, -1)


def part_frames(robot: Robot, q: jax.Array) -> _Frames:
    """Of the robot's bodies, in their order, and of the world.

    A joint a turn of a loop: outside of one, the compiler computes each from the base on.
    """
    joints = _joints(robot)
    values, cos, sin = (x[joints.index][:, None, None] for x in joint_terms(robot, q))
    still, *moving = (jnp.asarray(part, q.dtype)[..., None] for part in joints.parts)
    own = still + moving[0] * cos + moving[1] * sin + moving[2] * values
    world = jnp.broadcast_to(jnp.eye(3, 4)[..., None], (3, 4, len(q)))

    def turn(i: jax.Array, frames: jax.Array) -> jax.Array:
        return frames.at[i].set(compose_each(frames[jnp.asarray(joints.before)[i]], own[i]))

    frames = jnp.zeros((len(joints.before) + 1, *world.shape)).at[-1].set(world)
    frames = jax.lax.fori_loop(0, len(joints.before), turn, frames)[joints.last]
    return _Frames(frames[:, :, 3], frames[:, :, :3])


class _Joints(NamedTuple):
    """S joints, and what they move; a body without one has one that does nothing."""

    index: np.ndarray  # [S] positions in the configuration
    parts: np.ndarray  # [4 S 3 4] as of `behind`, in the frame behind the joint before
    before: np.ndarray  # [S] the joint before; -1 for the world
    last: np.ndarray  # [L + 1] of each body; the world's, -1, comes last


def _joints(robot: Robot) -> _Joints:
    index, parts, before, last = [], [], [], []
    for body in robot.bodies:
        at = last[body.parent] if body.parent >= 0 else -1
        own = transform_of(body.rotation, body.position)
        for joint in body.joints or (None,):
            index.append(0 if joint is None else joint.index)
            parts.append(behind(own, joint))
            before.append(at)
            at, own = len(before) - 1, transform_of(np.eye(3), np.zeros(3))
        last.append(at)
    return _Joints(*map(np.array, (index, np.stack(parts, axis=1), before, [*last, -1])))


def _seen(turned: jax.Array, origin: jax.Array, axes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Frames `[3 N]`, `[3 3 N]`, turned by rotations `[3 3 N]`."""
    position = jnp.sum(turned * origin, axis=1)
    return position, jnp.sum(turned[:, :, None] * axes[None], axis=1)


def bits_of(words: jax.Array, num: int) -> jax.Array:
    """Words `[..., W, C]` as booleans `[..., num, C]`."""
    place = jnp.arange(num)
    return (words[..., place // WORD, :] >> (place % WORD)[:, None]) & 1 > 0


def test_pairs(
    wanted: Bool[Array, "U N"], gaps: Callable[[jax.Array, jax.Array], jax.Array]
) -> Bool[Array, " N"]:
    """Configurations of which no wanted pair is in contact.

    Args:
        wanted: pairs to be tested, by configuration.
        gaps: of pairs at configurations, both `[N]`; not above 0 in contact.
    """
    num = wanted.shape[1]

    def some_left(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(state[0])

    def test_some(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, clear = state
        # As many as there are configurations; the others wait until these are decided.
        (found,) = jnp.nonzero(left, size=num, fill_value=len(left))
        pair, at = jnp.divmod(jnp.minimum(found, len(left) - 1), num)
        # Rows without a pair test the last again.
        touches = (found < len(left)) & ~(gaps(pair, at) > 0)
        clear = clear.at[jnp.where(touches, at, num)].set(False, mode="drop")
        left = left.at[found].set(False, mode="drop")
        return left & jnp.tile(clear, len(left) // num), clear

    state = wanted.reshape(-1), jnp.ones(num, bool)
    return jax.lax.while_loop(some_left, test_some, state)[1]
