"""The smallest of many short rows, all rows side by side."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def smallest(
    values: Float[Array, "R K"], count: int
) -> tuple[Float[Array, "R C"], Int[Array, "R C"]]:
    """The smallest of each row in rising order, of equal ones the first, and where they are.

    `jax.lax.top_k` sorts row by row on a CPU, which takes two to eight times as long where there
    are hundreds of rows of up to some fifty values. What is not a number counts as infinite.

    Args:
        values: any.
        count: C, up to K.
    """
    most = jnp.finfo(values.dtype).max  # what is infinite is taken once, too
    columns = jnp.where(values < most, values, most).T
    own = jnp.arange(len(columns))[:, None]

    def take(i: jax.Array, state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        left, found, at = state
        least = jnp.min(left, axis=0)
        # In place of `argmin`, which is not vectorized.
        first = jnp.min(jnp.where(left == least, own, len(columns)), axis=0)
        return jnp.where(own == first, jnp.inf, left), found.at[i].set(least), at.at[i].set(first)

    nothing = jnp.zeros((count, len(values)), values.dtype), jnp.zeros((count, len(values)), int)
    _, found, at = jax.lax.fori_loop(0, count, take, (columns, *nothing))
    return jnp.where(found < most, found, jnp.inf).T, at.T
