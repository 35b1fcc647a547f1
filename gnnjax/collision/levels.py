"""The two levels of a test: what spheres say of configurations, and what parts say of the rest."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.collision.exact import PartTests
from gnnjax.devices import platform
from gnnjax.scene.scene import Scene

# What spheres say of a configuration is a word of 32 bits: 0 where they prove it free. Bit
# m % OBSTACLE_BITS is set where they leave open whether obstacle m is touched, CLOUD where they
# leave open whether points are, ITSELF where they leave open whether the arm touches itself,
# BLOCKED where they prove a contact.
OBSTACLE_BITS = 29
CLOUD, ITSELF, BLOCKED = (np.uint32(1 << bit) for bit in (29, 30, 31))

# Configurations that spheres leave open, and are decided together: so many, and on an accelerator,
# which takes as long for a thousand as for one, a share of all.
_OPEN_AT_ONCE, _OPEN_SHARE = 32, 16

_Numbers = TypeVar("_Numbers", jax.Array, np.ndarray)


def names(words: _Numbers, number: _Numbers) -> _Numbers:
    """Whether words leave open that obstacles of such numbers are touched; both are broadcast."""
    return words >> (number % OBSTACLE_BITS).astype(np.uint32) & 1 > 0


class Levels(NamedTuple):
    """A test in two steps, of which the second is of what the first leaves open.

    `first(placed, owner [G], q [G T D]) -> [G T]` are words: 0 is free, `BLOCKED` and above is
    blocked, and others name what is left open to the second.
    """

    first: Callable[[Any, jax.Array, jax.Array], jax.Array]
    second: PartTests


class CollisionFunctions(NamedTuple):
    """What a backend is; see `Checker`."""

    clearance: Callable[[Scene, jax.Array], jax.Array]
    collision_free: Callable[[Scene, jax.Array], jax.Array]
    place: Callable[[Scene], Any]
    collision_free_each: Callable[[Any, jax.Array, jax.Array], jax.Array]
    levels: Levels | None  # of the last; None for an arm whose spheres leave nothing open


def are_free(
    levels: Levels, placed: Any, owner: Int[Array, " G"], q: Float[Array, "G T D"]
) -> Bool[Array, "G T"]:
    """Whether configurations are free, by both levels in one call.

    Args:
        levels: the test.
        placed: obstacles, as it wants them.
        owner: whose obstacles count.
        q: configurations.
    """
    words, second = levels.first(placed, owner, q), levels.second
    each, flat, configurations = q.shape[1], words.reshape(-1), q.reshape(-1, q.shape[-1])
    num = len(flat)
    many = _OPEN_AT_ONCE if platform() == "cpu" else max(_OPEN_AT_ONCE, num // _OPEN_SHARE)

    # All that is open, once: looking for the next in each turn took longer than all the rest.
    is_open = (flat > 0) & (flat < BLOCKED)
    (queue,) = jnp.nonzero(is_open, size=num, fill_value=num)
    queue = jnp.pad(queue, (0, many), constant_values=num)

    def decide_some(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        begin, free = state
        rows = jax.lax.dynamic_slice(queue, (begin,), (many,))
        at = jnp.minimum(rows, num - 1)
        asked, some = jnp.where(rows < num, flat[at], 0), configurations[at]
        clear = second.clear_of_itself(some, asked & ITSELF > 0)
        clear = clear_of_named(owner[at // each], asked, some, clear)
        return begin + many, free.at[rows].set(clear, mode="drop")

    def clear_of_named(
        owner: jax.Array, words: jax.Array, q: jax.Array, clear: jax.Array
    ) -> jax.Array:
        """Which are clear of the obstacles that words name, of those that are `clear`."""
        number = jnp.arange(len(placed.origins))[:, None]
        named = names(words, number) & clear

        def some_pairs(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            left, clear = state
            (found,) = jnp.nonzero(left, size=many, fill_value=len(left))
            of, at = jnp.divmod(jnp.minimum(found, len(left) - 1), len(q))
            apart = second.clear_of_obstacles(placed, owner[at], of, q[at], found < len(left))
            clear = clear.at[jnp.where(apart, len(q), at)].set(False, mode="drop")
            left = left.at[found].set(False, mode="drop")
            return left & jnp.tile(clear, len(left) // len(q)), clear

        state = named.reshape(-1), clear
        return jax.lax.while_loop(lambda state: jnp.any(state[0]), some_pairs, state)[1]

    num_open, state = is_open.sum(), (jnp.int32(0), flat == 0)
    free = jax.lax.while_loop(lambda state: state[0] < num_open, decide_some, state)[1]
    return free.reshape(words.shape)
