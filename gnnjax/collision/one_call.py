"""Both levels of a test in one call, for lone queries.

These spend more time between calls of a tenth of a millisecond than in them. What the first level
leaves open of obstacles the second decides at once, some pairs at a time, in the order of their
sequences; what comes after a configuration that is blocked is left.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from gnnjax.collision.levels import BLOCKED, CLOUD, ITSELF, Levels, names

_AT_ONCE = 64  # configurations that the first level sees together
_OPEN_AT_ONCE = 32  # pairs of a configuration and an obstacle that the second does


def decide(
    levels: Levels,
    placed: Any,
    number: Int[Array, " M"],
    owner: Int[Array, " G"],
    q: Float[Array, "G T D"],
    sequence: Int[Array, "G T"],
    wanted: Bool[Array, "G T"],
) -> UInt[Array, "G T"]:
    """Whether configurations are free, as far as obstacles are concerned, in one call.

    Args:
        levels: of a checker.
        placed: what it has placed.
        number: of the obstacles in a scene, from 0 on.
        owner: whose scene counts.
        q: configurations; those of a sequence lie side by side.
        sequence: of each, by numbers that rise by one from sequence to sequence.
        wanted: what counts, in the first groups.

    Returns:
        Words as of the first level, in which bits of obstacles are decided: BLOCKED where one is
        touched, and in whatever comes after that in a sequence; zero where none is.
    """
    num, tiles = wanted.size, _AT_ONCE // q.shape[1]
    flat, place = q.reshape(num, -1), jnp.arange(num)

    def first(i: jax.Array, words: jax.Array) -> jax.Array:
        own = (jax.lax.dynamic_slice_in_dim(x, i * tiles, tiles) for x in (owner, q))
        found = levels.first(placed, *own)
        return jax.lax.dynamic_update_slice_in_dim(words, found, i * tiles, 0)

    blocks = (jnp.sum(wanted.any(axis=1)) + tiles - 1) // tiles
    words = jax.lax.fori_loop(0, blocks, first, jnp.zeros(q.shape[:2], jnp.uint32)).reshape(-1)
    of, wanted = jnp.clip(sequence - sequence[0, 0], 0, num - 1).reshape(-1), wanted.reshape(-1)
    blocked = wanted & (words >= BLOCKED)
    end = jnp.full(num, num).at[of].min(jnp.where(blocked, place, num))  # of a sequence
    named = names(words[:, None], number)

    def some_left(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(state[0])

    def test_some(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, end = state
        (found,) = jnp.nonzero(left.reshape(-1), size=_OPEN_AT_ONCE, fill_value=left.size)
        real = found < left.size
        at, which = jnp.divmod(jnp.minimum(found, left.size - 1), len(number))
        asked = owner[at // q.shape[1]], number[which], flat[at], real
        clear = levels.second.clear_of_obstacles(placed, *asked)
        end = end.at[of[at]].min(jnp.where(clear, num, at))
        left = left.reshape(-1).at[found].set(False, mode="drop").reshape(left.shape)
        return left & (place < end[of])[:, None], end

    if len(number):
        state = named & (wanted & (place < end[of]))[:, None], end
        end = jax.lax.while_loop(some_left, test_some, state)[1]
    rest = words & (CLOUD | ITSELF)
    return jnp.where(place < end[of], rest, BLOCKED).reshape(q.shape[:2])
