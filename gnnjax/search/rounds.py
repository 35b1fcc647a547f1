"""Lazy search in rounds: the cheapest path by what is known, and what a test of it taught.

Between two rounds somebody tests configurations, of one problem or of a thousand together. All here
is for one problem; `vmap` it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8

from gnnjax.roadmap.graph import GOAL, START, Roadmap
from gnnjax.roadmap.paths import follow
from gnnjax.search.knowledge import INVALID, UNKNOWN, Knowledge


class Priced(NamedTuple):
    """A roadmap under search."""

    roadmap: Roadmap
    price: Float[Array, "*batch N K"]  # rad; what an edge costs beside its length while unknown
    judged: Bool[Array, "*batch N K"]  # the price is final
    known: Knowledge


class Route(NamedTuple):
    """The cheapest path by what is known, step by step; step i leads from node i to node i + 1."""

    path: Int[Array, "*batch N"]  # nodes; -1 after the last
    slots: Int[Array, "*batch N"]  # through which the path leaves its nodes
    points: Float[Array, "*batch N D"]  # configurations; the goal again after the last
    num: Int[Array, "*batch"]  # nodes on the path; 0 without one
    node_unknown: Bool[Array, "*batch N"]
    edge_unknown: Bool[Array, "*batch N"]
    edge_price: Float[Array, "*batch N"]  # 0 where the edge is known
    unjudged: Bool[Array, "*batch N"]


def cheapest_routes(priced: Priced) -> Route:
    """The path that is cheapest by length and by the prices of what is not known.

    For a batch `[P]`: one flat look-up for all is twice as fast as one mapped over problems.
    """
    roadmap, (status, node_status) = priced.roadmap, priced.known
    num, num_nodes, _ = status.shape
    price = jnp.where(status == UNKNOWN, priced.price, 0.0)
    blocked = (status == INVALID) | (node_status == INVALID)[..., None]
    edge_cost = roadmap.lengths + price
    edge_cost = jnp.where(blocked | ~roadmap.neighbor_mask, jnp.inf, edge_cost)
    flat = roadmap.neighbors + (jnp.arange(num, dtype=jnp.int32) * num_nodes)[:, None, None]

    def beyond(cost: jax.Array) -> jax.Array:
        return edge_cost + cost.ravel()[flat]

    def sweep(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cost, going_on = state
        better = jnp.minimum(cost, jnp.min(beyond(cost), axis=-1))
        # Those that are through wait: more sweeps for others must not change what is equally cheap.
        better = jnp.where(going_on[:, None], better, cost)
        # What is dearer than the start already is not on its way.
        changed = (better < cost) & (better <= better[:, START, None])
        return better, jnp.any(changed, axis=1)

    first = jnp.full((num, num_nodes), jnp.inf).at[:, GOAL].set(0.0)
    everyone = jnp.ones(num, bool)
    cost, _ = jax.lax.while_loop(lambda state: jnp.any(state[1]), sweep, (first, everyone))
    slots = jnp.argmin(beyond(cost), axis=-1).astype(jnp.int32)
    path = jax.vmap(follow)(roadmap, slots, cost)
    return jax.vmap(_route)(priced, price, path, slots)


def _route(
    priced: Priced,
    price: Float[Array, "N K"],
    path: Int[Array, " N"],
    slots: Int[Array, " N"],
) -> Route:
    roadmap, (status, node_status) = priced.roadmap, priced.known
    node = jnp.maximum(path, 0)
    slot = slots[node]
    arrives = jnp.any(path == GOAL)
    on_path = (path >= 0) & arrives
    leaves = on_path & (path != GOAL)
    edge_unknown = leaves & (status[node, slot] == UNKNOWN)
    return Route(
        path=path,
        slots=slot,
        points=roadmap.nodes[jnp.where(path >= 0, path, GOAL)],
        num=jnp.sum(on_path),
        node_unknown=on_path & (node_status[node] == UNKNOWN),
        edge_unknown=edge_unknown,
        edge_price=jnp.where(edge_unknown, price[node, slot], 0.0),
        unjudged=edge_unknown & ~priced.judged[node, slot],
    )


def _both_ways(
    roadmap: Roadmap, path: Int[Array, " N"], slots: Int[Array, " N"], wanted: Bool[Array, " N"]
) -> tuple[jax.Array, jax.Array]:
    """Node and slot `[2 N]` of the edges of a path, from either end; node N where not wanted."""
    num = len(path)
    near = jnp.maximum(path, 0)
    far = roadmap.neighbors[near, slots]
    back = jnp.argmax(
        (roadmap.neighbors[far] == near[:, None]) & roadmap.neighbor_mask[far], axis=1
    )
    node = jnp.concatenate([jnp.where(wanted, near, num), jnp.where(wanted, far, num)])
    return node, jnp.concatenate([slots, back.astype(slots.dtype)])


def learn(
    priced: Priced, route: Route, nodes: Int8[Array, " N"], edges: Int8[Array, " N"]
) -> Knowledge:
    """What is known once the nodes and edges of a route were tested.

    Args:
        priced: the roadmap.
        route: from `cheapest_route`.
        nodes: by step: what was found out; UNKNOWN where nothing was.
        edges: likewise.
    """
    status, node_status = priced.known
    at = jnp.where(nodes != UNKNOWN, route.path, len(node_status))
    node, slot = _both_ways(priced.roadmap, route.path, route.slots, edges != UNKNOWN)
    return Knowledge(
        status.at[node, slot].set(jnp.tile(edges, 2), mode="drop"),
        node_status.at[at].set(nodes, mode="drop"),
    )


def reprice(
    priced: Priced, route: Route, steps: Int[Array, " B"], price: Float[Array, " B"]
) -> Priced:
    """A closer look at the price of some edges of a route.

    Args:
        priced: the roadmap.
        route: from `cheapest_route`.
        steps: along the route; -1 for none.
        price: of their edges.
    """
    num = len(route.path)
    steps = jnp.where(steps >= 0, steps, num)  # dropped
    wanted = jnp.zeros(num, bool).at[steps].set(True, mode="drop")
    values = jnp.zeros(num).at[steps].set(price, mode="drop")
    at = _both_ways(priced.roadmap, route.path, route.slots, wanted)
    return priced._replace(
        price=priced.price.at[at].set(jnp.tile(values, 2), mode="drop"),
        judged=priced.judged.at[at].set(True, mode="drop"),
    )
