"""A few points along a path, and the shortest way over the motions between them that hold.

For one path, as functions of arrays; `vmap` them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

POINTS = 14  # of a path between which shortcuts are tested
FIRST, SECOND = np.triu_indices(POINTS, 1)  # ends of the motions between them


def spread_out(
    path: Float[Array, "T D"], num: Int[Array, ""]
) -> tuple[Float[Array, "V D"], Int[Array, " V"]]:
    """Points along a path, its corners among them, and the edge that leads on from each."""
    steps = len(path) - 1
    real = jnp.arange(steps) < num - 1
    lengths = jnp.where(real, jnp.linalg.norm(jnp.diff(path, axis=0), axis=1), 0.0)

    def cut(_, pieces):  # the longest piece is cut next
        more = (jnp.sum(pieces) < POINTS - 1).astype(pieces.dtype)
        return pieces.at[jnp.argmax(lengths / jnp.maximum(pieces, 1))].add(more)

    pieces = jax.lax.fori_loop(0, POINTS - 1, cut, real.astype(jnp.int32))
    last = jnp.cumsum(pieces)
    place = jnp.arange(POINTS)
    edge = jnp.minimum(jnp.searchsorted(last, place, side="right"), jnp.maximum(num - 2, 0))
    share = (place - (last[edge] - pieces[edge])) / jnp.maximum(pieces[edge], 1)
    inner = path[edge] + share.astype(path.dtype)[:, None] * (path[edge + 1] - path[edge])
    is_last = place >= last[-1]
    return jnp.where(is_last[:, None], path[jnp.maximum(num - 1, 0)], inner), edge


def shortest(lengths: Float[Array, " E"]) -> tuple[Int[Array, " V"], Int[Array, ""]]:
    """The shortest way from the first of V points to the last over motions of some lengths: which
    points, the last repeated, and how many."""
    matrix = jnp.full((POINTS, POINTS), jnp.inf).at[FIRST, SECOND].set(lengths)
    cost, before = jnp.full(POINTS, jnp.inf).at[0].set(0.0), jnp.zeros(POINTS, jnp.int32)
    for j in range(1, POINTS):
        through = cost + matrix[:, j]
        best = jnp.argmin(through).astype(jnp.int32)
        cost, before = cost.at[j].set(through[best]), before.at[j].set(best)
    on_way = jnp.zeros(POINTS, bool).at[POINTS - 1].set(True)
    at = jnp.int32(POINTS - 1)
    for _ in range(POINTS - 1):
        at = before[at]
        on_way = on_way.at[at].set(True)
    (way,) = jnp.nonzero(on_way, size=POINTS, fill_value=POINTS - 1)
    return way, jnp.sum(on_way)
