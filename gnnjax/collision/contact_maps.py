"""Maps of the joint values at which two parts of an arm touch, where few joints move them apart.

Parts that are near each other along an arm, such as a base and an upper arm, are those of which
spheres tell least: what is around them overlaps in half of all configurations. But two or three
joints are all that moves one against the other. So a grid over the values of these is worked out
once an arm (`contact_cells.py`), and its cells tell where the parts are clear of each other, where
they touch, and where neither is proven. To look one up costs less than some spheres' distances.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from gnnjax.arm.hulls import simpler_hulls
from gnnjax.arm.robot import Robot
from gnnjax.collision.contact_cells import A_WORD, CLEAR, OPEN, Cells, cells_of
from gnnjax.collision.couples import couple_of, ranges
from gnnjax.files import cache_folder
from gnnjax.kept import kept_result
from gnnjax.notice import told_if_long

_A_WORD_BITS = A_WORD.bit_length() - 1
_SHIFT = 30  # of what a cell says: bits 30 and 31 of a word, see `spheres.py`
_FAR = 1e3  # rad; joints that turn as far are not looked up
_LINE = (
    "gnnjax: working out where parts of {} touch each other, which may take half a minute; it is "
    "kept in {}"
)


class ContactMap(NamedTuple):
    """The map of one pair of parts."""

    pair: int  # which of `Robot.part_pairs`
    joints: np.ndarray  # [K] positions in the configuration
    lower: np.ndarray  # [K] float32, rad or m
    upper: np.ndarray  # [K] float32; one turn above `lower` where joints turn more than that
    turns: np.ndarray  # [K] whether they do
    cells: Cells

    def codes(self, q: Float[Array, "*batch D"]) -> UInt[Array, "*batch"]:
        """What it says of configurations: `CLEAR`, `OPEN` or `TOUCHING`."""
        block, within = jnp.zeros((2, *q.shape[:-1]), jnp.int32)
        outside = jnp.zeros(q.shape[:-1], bool)
        cells = self.cells.counts, self.cells.block
        for joint, low, high, turns, count, size in zip(
            *(x.tolist() for x in (*self[1:5], *cells)), strict=True
        ):
            value = q[..., joint]
            at = jnp.floor((value - low) * (count / (high - low))).astype(jnp.int32)
            if turns:
                at, inside = at & (count - 1), jnp.abs(value) < _FAR
            else:
                at, inside = jnp.clip(at, 0, count - 1), (value >= low) & (value <= high)
            block = block * (count // size) + (at >> (size.bit_length() - 1))
            within = within * size + (at & (size - 1))
            outside |= ~inside  # NaN is not inside
        index = block * int(self.cells.block.prod()) + within
        word = jnp.asarray(self.cells.words)[index >> _A_WORD_BITS]
        code = word >> (2 * (index & (A_WORD - 1))).astype(jnp.uint32) & 3
        return jnp.where(outside, jnp.uint32(OPEN), code)


class ContactMaps(NamedTuple):
    """All maps of an arm, and which pairs of its spheres they leave to be looked at."""

    alone: tuple[ContactMap, ...]  # which say all that spheres would
    beside: tuple[ContactMap, ...]  # which are to be asked about what spheres leave open
    pairs_beside: np.ndarray  # [S 2] of `Robot.sphere_pairs`, those of the latter
    pairs: np.ndarray  # [S 2] those of no map; none of parts that never touch

    def words(self, maps: tuple[ContactMap, ...], q: Float[Array, "*batch D"]) -> jax.Array:
        """What some maps say, as words (see `spheres.py`): `ITSELF` where one leaves it open,
        `BLOCKED` and above where one says that parts touch."""
        words = jnp.zeros(q.shape[:-1], jnp.uint32)
        for one in maps:
            words |= one.codes(q) << _SHIFT
        return words

    def not_clear(self, touching: Bool[Array, "U N"], q: Float[Array, "N D"]) -> Bool[Array, "U N"]:
        """Of which pairs of parts nothing is proven yet, where spheres without a map, or beside
        one, are `touching`."""
        for one in self.beside:
            touching = touching.at[one.pair].min(one.codes(q) != CLEAR)
        for one in self.alone:
            touching = touching.at[one.pair].set(one.codes(q) != CLEAR)
        return touching


@functools.cache
def contact_maps(robot: Robot) -> ContactMaps:
    """The maps of an arm; seconds of work, kept in the cache folder."""
    vertices, radii = simpler_hulls(robot)
    alone, beside, settled, joined = [], [], set(), set()
    of = np.sort(robot.sphere_parts[robot.sphere_pairs], axis=1)
    for number, parts in enumerate(robot.part_pairs.tolist()):
        if {robot.parts[p].body for p in parts} & set(robot.held_bodies):
            continue  # what an arm holds comes and goes
        own = (of == sorted(parts)).all(axis=1)
        found = couple_of(robot, parts, robot.sphere_pairs[own], vertices, radii)
        if found is None:
            continue
        joints, couple = found
        line = _LINE.format(robot.name, cache_folder("code"))
        # Whoever traces a function that makes a checker wants numbers here.
        with told_if_long(line), jax.ensure_compile_time_eval():
            cells = kept_result(cells_of, couple)
        if cells is None:
            continue
        (joined if cells.beside else settled).update(np.flatnonzero(own).tolist())
        if cells.words.any():
            lower, upper, turns = ranges(couple)
            low, high = lower.astype(np.float32), upper.astype(np.float32)
            one = ContactMap(number, joints, low, high, turns, cells)
            (beside if cells.beside else alone).append(one)
    rest = np.setdiff1d(np.arange(len(of)), [*settled, *joined])
    pairs_beside = robot.sphere_pairs[sorted(joined)]
    return ContactMaps(tuple(alone), tuple(beside), pairs_beside, robot.sphere_pairs[rest])
