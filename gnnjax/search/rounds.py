"""Lazy search in rounds: the cheapest path by what is known, and what a test of it taught.

Between two rounds somebody tests configurations, of one problem or of a thousand together. All here
is for one problem; `vmap` it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8

from gnnjax.roadmap.graph import GOAL, START, Roadmap
from gnnjax.roadmap.paths import cost_to_go, follow, next_slots
from gnnjax.roadmap.smallest import smallest
from gnnjax.search.knowledge import INVALID, UNKNOWN, Knowledge

MOST_STEPS = 128  # nodes of a path that is found; cheapest paths have a tenth


class Priced(NamedTuple):
    """A roadmap under search."""

    roadmap: Roadmap
    price: Float[Array, "*batch N K"]  # rad; what an edge costs beside its length while unknown
    judged: Bool[Array, "*batch N K"]  # the price is final
    known: Knowledge


class Route(NamedTuple):
    """The cheapest path by what is known, step by step; step i leads from node i to node i + 1."""

    path: Int[Array, "*batch T"]  # nodes; -1 after the last
    slots: Int[Array, "*batch T"]  # through which the path leaves its nodes
    points: Float[Array, "*batch T D"]  # configurations; the goal again after the last
    num: Int[Array, "*batch"]  # nodes on the path; 0 without one
    node_unknown: Bool[Array, "*batch T"]
    edge_unknown: Bool[Array, "*batch T"]
    edge_price: Float[Array, "*batch T"]  # 0 where the edge is known
    unjudged: Bool[Array, "*batch T"]


def keep_cheapest(priced: Priced, num_slots: int) -> Priced:
    """Keeps of each node the slots whose edges are cheapest by length and price.

    Edges that are dear from a node's view hardly ever come to be on a cheapest path, and a search
    looks at all of them in every sweep. An edge may be left at one of its ends alone.

    Args:
        priced: N nodes with K slots.
        num_slots: those that are kept; K if there are no more.
    """
    roadmap, (status, node_status) = priced.roadmap, priced.known
    blocked = ~roadmap.neighbor_mask | (status == INVALID)
    cost = jnp.where(blocked, jnp.inf, roadmap.lengths + priced.price)
    # Behind a barrier, as in `connect_where`.
    _, kept = jax.lax.optimization_barrier(smallest(cost, min(num_slots, cost.shape[1])))

    def take(x: jax.Array) -> jax.Array:
        return jnp.take_along_axis(x, kept, axis=1)

    roadmap = roadmap._replace(
        neighbors=take(roadmap.neighbors),
        neighbor_mask=take(roadmap.neighbor_mask),
        lengths=take(roadmap.lengths),
    )
    known = Knowledge(take(status), node_status)
    return Priced(roadmap, take(priced.price), take(priced.judged), known)


def cheapest_route(priced: Priced) -> Route:
    """The path that is cheapest by length and by the prices of what is not known.

    None where that has more than `MOST_STEPS` nodes.
    """
    roadmap, (status, node_status) = priced.roadmap, priced.known
    price = jnp.where(status == UNKNOWN, priced.price, 0.0)
    blocked = (status == INVALID) | (node_status == INVALID)[:, None]
    edge_cost = jnp.where(blocked, jnp.inf, roadmap.lengths + price)
    cost = cost_to_go(roadmap, edge_cost, GOAL, START)
    slots = next_slots(roadmap, edge_cost, cost)
    path = follow(roadmap, slots, cost, min(MOST_STEPS, len(cost)))
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
    roadmap: Roadmap, path: Int[Array, " T"], slots: Int[Array, " T"], wanted: Bool[Array, " T"]
) -> tuple[jax.Array, jax.Array]:
    """Node and slot `[2 T]` of the edges of a path, from either end; node N where not wanted, or
    where an end does without the edge."""
    num = len(roadmap.nodes)
    near = jnp.maximum(path, 0)
    far = roadmap.neighbors[near, slots]
    same = (roadmap.neighbors[far] == near[:, None]) & roadmap.neighbor_mask[far]
    back = jnp.argmax(same, axis=1)
    both = wanted & jnp.any(same, axis=1)
    node = jnp.concatenate([jnp.where(wanted, near, num), jnp.where(both, far, num)])
    return node, jnp.concatenate([slots, back.astype(slots.dtype)])


def learn(
    priced: Priced, route: Route, nodes: Int8[Array, " T"], edges: Int8[Array, " T"]
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
