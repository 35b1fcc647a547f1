"""Cheapest ways in a roadmap, and what holds of all of its edges."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gnnjax.collision.edges import EdgeChecks
from gnnjax.roadmap.graph import GOAL, START, Roadmap, reverse_slots


class ValidityLabels(NamedTuple):
    """Validity of all edges of a roadmap and what it took to find out."""

    edge_valid: Bool[Array, "*batch N K"]
    num_edge_checks: Int[Array, "*batch"]  # undirected edges
    num_checks: Int[Array, "*batch"]  # configurations, as a sequential test would count


def edge_validity(
    roadmap: Roadmap, check_edges: Callable[[jax.Array, jax.Array], EdgeChecks]
) -> ValidityLabels:
    """Checks every undirected edge of a roadmap once.

    Args:
        roadmap: N nodes with K slots.
        check_edges: `(starts [E D], ends [E D]) -> EdgeChecks`, for all edges at once and padding.
    """
    slots, *ends = _every_edge(roadmap)
    checks = check_edges(*ends)
    tested = jnp.sum(checks.num_checks, where=slots >= 0)
    valid = _both_ways(roadmap, slots, checks.valid)
    return ValidityLabels(valid, (slots >= 0).sum().astype(jnp.int32), tested)


def edges_that(
    roadmap: Roadmap, hold: Callable[[jax.Array, jax.Array], jax.Array]
) -> Bool[Array, "N K"]:
    """Which edges hold, each asked about once; false on padding.

    Args:
        roadmap: N nodes with K slots.
        hold: `(starts [E D], ends [E D]) -> [E]`, for all edges at once and padding.
    """
    slots, *ends = _every_edge(roadmap)
    return _both_ways(roadmap, slots, hold(*ends))


def _every_edge(roadmap: Roadmap) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A slot `[E]` of every undirected edge, -1 on padding, and its ends `[E D]`."""
    num, num_slots = roadmap.neighbors.shape
    own = jnp.arange(num)[:, None]
    once = (roadmap.neighbor_mask & (own < roadmap.neighbors)).reshape(-1)
    (slots,) = jnp.nonzero(once, size=num * num_slots // 2, fill_value=-1)
    real = slots >= 0
    # Padding edges go from a node to itself, which costs no configuration.
    sender = jnp.where(real, slots // num_slots, 0)
    receiver = jnp.where(real, roadmap.neighbors.reshape(-1)[slots], 0)
    return slots, roadmap.nodes[sender], roadmap.nodes[receiver]


def _both_ways(
    roadmap: Roadmap, slots: Int[Array, " E"], holds: Bool[Array, " E"]
) -> Bool[Array, "N K"]:
    """What holds of the edges in some slots, in both slots of each; false elsewhere."""
    found = (slots >= 0) & holds
    other_way = reverse_slots(roadmap).reshape(-1)[slots]
    outside = roadmap.neighbors.size
    valid = jnp.zeros(outside, bool)
    for way in (slots, other_way):
        valid = valid.at[jnp.where(found, way, outside)].set(True, mode="drop")
    return valid.reshape(roadmap.neighbors.shape)


def for_each_edge(
    roadmap: Roadmap, value: Callable[[jax.Array, jax.Array], jax.Array], block: int = 256
) -> Float[Array, "N K"]:
    """A value of every undirected edge, the same in both its slots; zero on padding.

    Args:
        roadmap: N nodes with K slots.
        value: `(starts [B D], ends [B D]) -> [B]`.
        block: B, edges at once.
    """
    once = roadmap.neighbor_mask & (jnp.arange(len(roadmap.nodes))[:, None] < roadmap.neighbors)
    values = for_wanted_edges(roadmap.nodes, roadmap.neighbors, once, value, block).ravel()
    other_way = jnp.where(once, reverse_slots(roadmap), once.size).ravel()  # beyond: dropped
    return values.at[other_way].set(values, mode="drop").reshape(once.shape)


def for_wanted_edges(
    nodes: Float[Array, "N D"],
    neighbors: Int[Array, "R K"],
    wanted: Bool[Array, "R K"],
    value: Callable[[jax.Array, jax.Array], jax.Array],
    block: int = 256,
) -> Float[Array, "R K"]:
    """A value of some edges of the first R nodes; zero elsewhere.

    Args:
        nodes: configurations.
        neighbors: node in each slot of the first R.
        wanted: which of the slots count.
        value: `(starts [B D], ends [B D]) -> [B]`.
        block: B, edges at once.
    """
    num, num_slots = wanted.size, wanted.shape[1]
    (slots,) = jnp.nonzero(wanted.ravel(), size=num + block, fill_value=num)
    far = neighbors.ravel()

    def ask(i: jax.Array, values: jax.Array) -> jax.Array:
        slot = jax.lax.dynamic_slice_in_dim(slots, i * block, block)
        found = value(nodes[slot // num_slots], nodes[far[slot]])
        return values.at[slot].set(found, mode="drop")

    blocks = (wanted.sum() + block - 1) // block
    return jax.lax.fori_loop(0, blocks, ask, jnp.zeros(num)).reshape(wanted.shape)


def cost_to_go(
    roadmap: Roadmap,
    edge_cost: Float[Array, "N K"],
    goal: int | Int[Array, ""] = GOAL,
    start: int | Int[Array, ""] | None = None,
) -> Float[Array, " N"]:
    """Cost of the cheapest way from every node to the goal, by Bellman-Ford sweeps.

    Args:
        roadmap: N nodes with K slots.
        edge_cost: non-negative cost of each slot's edge; inf where it cannot be used.
        goal: node to reach.
        start: stop as soon as its cost, and those of the nodes on its way, are final; the others
            may come out too high then.
    """
    edge_cost = jnp.where(roadmap.neighbor_mask, edge_cost, jnp.inf)
    costs = jnp.full(len(roadmap.nodes), jnp.inf).at[goal].set(0.0)

    def changing(state):
        return state[1]

    def sweep(state):
        cost, _ = state
        better = jnp.minimum(cost, jnp.min(edge_cost + cost[roadmap.neighbors], axis=1))
        changed = better < cost
        if start is not None:
            # What is dearer than the start already is not on its way.
            changed &= better <= better[start]
        return better, jnp.any(changed)

    return jax.lax.while_loop(changing, sweep, (costs, jnp.bool_(True)))[0]


def next_slots(
    roadmap: Roadmap, edge_cost: Float[Array, "N K"], cost: Float[Array, " N"]
) -> Int[Array, " N"]:
    """The slot through which the cheapest way to the goal leaves each node, given its cost-to-go.

    Any slot where the goal cannot be reached.
    """
    edge_cost = jnp.where(roadmap.neighbor_mask, edge_cost, jnp.inf)
    return jnp.argmin(edge_cost + cost[roadmap.neighbors], axis=1).astype(jnp.int32)


def follow(
    roadmap: Roadmap,
    slots: Int[Array, " N"],
    cost: Float[Array, " N"],
    most: int | None = None,
) -> Int[Array, " T"]:
    """The nodes met on the way from the start to the goal along `slots`; -1 after the last.

    Only the start if the goal's cost-to-go there is infinite.

    Args:
        roadmap: N nodes.
        slots: through which the way leaves each node.
        cost: to the goal, from each node.
        most: T, nodes that are followed; N by default.
    """
    most = len(slots) if most is None else most
    path = jnp.full(most, -1, jnp.int32).at[0].set(START)

    def walking(state):
        node, steps, _ = state
        return (node != GOAL) & jnp.isfinite(cost[START]) & (steps < most)

    def step(state):
        node, steps, path = state
        node = roadmap.neighbors[node, slots[node]]
        return node, steps + 1, path.at[steps].set(node)

    return jax.lax.while_loop(walking, step, (jnp.int32(START), jnp.int32(1), path))[2]
