"""Shortens paths before they are checked.

What a guide says of a motion costs no check. So a path is first shortened in the guide's eyes:
points along it make a small roadmap in which all are joined to all, and the cheapest way through
that is a shorter path. Only then is it checked (`planning/shorten_by_guide.py`).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gnnjax.roadmap.graph import GOAL, Roadmap
from gnnjax.roadmap.paths import cost_to_go, follow, next_slots

PATH_POINTS = 20  # along a path
_ROUNDS = 2  # of shortening; the third gains nothing (docs/experiments.md)


def path_roadmap(points: Float[Array, "V D"]) -> Roadmap:
    """The points of a path, the goal moved to node 1, joined all to all."""
    num = len(points)
    apart = ~jnp.eye(num, dtype=bool)
    squared = sum((points[:, None, d] - points[None, :, d]) ** 2 for d in range(points.shape[1]))
    return Roadmap(
        nodes=points,
        node_mask=jnp.ones(num, bool),
        neighbors=jnp.broadcast_to(jnp.arange(num, dtype=jnp.int32), (num, num)),
        neighbor_mask=apart,
        lengths=jnp.sqrt(jnp.where(apart, jnp.asarray(squared), 0.0)),
        num_dropped=jnp.int32(0),
    )


def spread_evenly(
    path: Int[Array, " N"], nodes: Float[Array, "N D"], num: int
) -> Float[Array, "V D"]:
    """`num` points at equal distances along a path: first its start, then its goal, then the rest.

    Args:
        path: nodes from the start to the goal; -1 after the last.
        nodes: configurations.
        num: V.
    """
    return spread_along(nodes[jnp.where(path >= 0, path, GOAL)], num)


def spread_along(line: Float[Array, "N D"], num: int) -> Float[Array, "V D"]:
    """`spread_evenly` of the configurations of a path, the goal again after the last."""
    steps = jnp.linalg.norm(jnp.diff(line, axis=0), axis=-1)
    reached = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
    wanted = jnp.linspace(0.0, 1.0, num)[1:-1] * reached[-1]
    piece = jnp.clip(jnp.searchsorted(reached, wanted, side="right") - 1, 0, len(steps) - 1)
    fraction = (wanted - reached[piece]) / jnp.maximum(steps[piece], 1e-9)
    between = line[piece] + fraction[:, None] * (line[piece + 1] - line[piece])
    return jnp.concatenate([line[jnp.array([0, -1])], between])


def shortened(
    points: Float[Array, "V D"],
    price: Callable[[jax.Array, jax.Array], jax.Array],
) -> tuple[Roadmap, Float[Array, "V V"]]:
    """The path roadmap of a path that is shortened in the guide's eyes, and its prices.

    Args:
        points: from `spread_evenly`.
        price: `(starts [E D], ends [E D]) -> [E]`, rad: what a motion costs beside its length.
    """
    num = len(points)
    near, far = jnp.triu_indices(num, 1)

    def again(number: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        points, prices = state
        roadmap = path_roadmap(points)
        edge_cost = roadmap.lengths + prices
        cost = cost_to_go(roadmap, edge_cost, GOAL)
        path = follow(roadmap, next_slots(roadmap, edge_cost, cost), cost)
        # The first time there are no prices yet; this way their code is compiled but once.
        points = jnp.where(number > 0, spread_evenly(path, points, num), points)
        prices = jnp.zeros((num, num)).at[near, far].set(price(points[near], points[far]))
        return points, prices + prices.T

    points, prices = jax.lax.fori_loop(0, _ROUNDS, again, (points, jnp.zeros((num, num))))
    return path_roadmap(points), prices
