"""Free configurations, drawn uniformly by rejection."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


class Samples(NamedTuple):
    """Free configurations and what drawing them cost."""

    nodes: Float[Array, "*batch N D"]  # rad or m; only where `mask`
    mask: Bool[Array, "*batch N"]  # false where the draws ran out
    num_checks: Int[Array, "*batch"]  # configurations tested until the last one was found


def sample_free(
    key: jax.Array,
    check_configurations: Callable[[jax.Array], jax.Array],
    lower: np.ndarray | jax.Array,
    upper: np.ndarray | jax.Array,
    num: int,
    *,
    wanted: int | Int[Array, ""] | None = None,
    max_blocks: int = 50,
) -> Samples:
    """Draws configurations uniformly between the joint limits and keeps the valid ones.

    Args:
        key: randomness.
        check_configurations: `[B D] -> [B]`, true where valid.
        lower: `[D]` lower joint limits.
        upper: `[D]` upper joint limits.
        num: N, the size of the result.
        wanted: stop after that many; by default N.
        max_blocks: give up after that many blocks of N draws.
    """
    wanted = jnp.asarray(num if wanted is None else wanted, jnp.int32)
    num_dof = len(lower)

    def unfinished(state):
        count, blocks, *_ = state
        return (count < wanted) & (blocks < max_blocks)

    def draw_block(state):
        count, blocks, num_checks, nodes = state
        block_key = jax.random.fold_in(key, blocks)
        q = jax.random.uniform(block_key, (num, num_dof), minval=lower, maxval=upper)
        valid = check_configurations(q)
        rank = count + jnp.cumsum(valid) - 1
        used = valid & (rank < wanted)
        nodes = nodes.at[jnp.where(used, rank, num)].set(q, mode="drop")
        # A sequential sampler stops at the last configuration it needs.
        is_last = used & (rank == wanted - 1)
        tested = jnp.where(jnp.any(is_last), jnp.argmax(is_last) + 1, num)
        return count + used.sum(), blocks + 1, num_checks + tested, nodes

    zero = jnp.int32(0)
    nodes = jnp.zeros((num, num_dof), jnp.float32)
    count, _, num_checks, nodes = jax.lax.while_loop(
        unfinished, draw_block, (zero, zero, zero, nodes)
    )
    return Samples(nodes, jnp.arange(num) < count, num_checks)
