"""Searches on a roadmap that check the edges they need.

`greedy_search` is Algorithm 1 of Diao, Chi and Wang; what ranks the neighbours is an argument, so
the network, the distance to the goal and the exact cost-to-go run through the same code.
`lazy_search` is LazySP (Dellin and Srinivasa, 2016) on the same roadmap.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8

from gnnjax.collision import EdgeChecks
from gnnjax.encoding import Encoding
from gnnjax.labels import cost_to_go, next_slots
from gnnjax.model import GuidanceNetwork
from gnnjax.roadmap import Roadmap, reverse_slots

START, GOAL = 0, 1

# Edge status: what is known of a slot's edge.
UNKNOWN, VALID, INVALID = 0, 1, 2


class Scorer(NamedTuple):
    """What ranks the neighbours of the node a search stands at.

    `init() -> carry`; `advance(carry, node) -> carry` when a node joins the path, the start
    included; `values(carry, node) -> [K]` guidance values of the node's slots, higher is better.
    """

    init: Callable[[], Any]
    advance: Callable[[Any, jax.Array], Any]
    values: Callable[[Any, jax.Array], jax.Array]


class SearchResult(NamedTuple):
    """A walk on the roadmap, and what it cost."""

    path: Int[Array, "*batch N"]  # nodes walked, start first; -1 after the last
    success: Bool[Array, "*batch"]  # the walk ends at the goal
    edge_checks: Int[Array, "*batch"]  # edges tested
    configuration_checks: Int[Array, "*batch"]  # configurations tested for them
    edge_status: Int8[Array, "*batch N K"]  # what is now known of every slot's edge


def goal_distances(roadmap: Roadmap) -> Float[Array, " N"]:
    """Euclidean distance of every node to the goal."""
    return jnp.linalg.norm(roadmap.nodes - roadmap.nodes[GOAL], axis=-1)


def static_scorer(values: Callable[[jax.Array], jax.Array]) -> Scorer:
    """A scorer that does not remember the path: `values(node) -> [K]`."""
    return Scorer(
        init=lambda: (), advance=lambda carry, node: carry, values=lambda carry, node: values(node)
    )


def distance_scorer(roadmap: Roadmap) -> Scorer:
    """Prefers the neighbour nearest to the goal."""
    distances = goal_distances(roadmap)
    return static_scorer(lambda node: -distances[roadmap.neighbors[node]])


def oracle_scorer(roadmap: Roadmap, cost: Float[Array, " N"]) -> Scorer:
    """Prefers the neighbour on the shortest valid path, given the exact cost-to-go."""
    return static_scorer(lambda node: -(roadmap.lengths[node] + cost[roadmap.neighbors[node]]))


def network_scorer(network: GuidanceNetwork, encoding: Encoding, roadmap: Roadmap) -> Scorer:
    """Prefers what the guidance network does, which remembers the path walked so far."""
    return Scorer(
        init=network.init_path,
        advance=lambda carry, node: network.extend_path(encoding, carry, node),
        values=lambda carry, node: network.guidance_values(encoding, carry, roadmap, node),
    )


def unknown_edges(roadmap: Roadmap) -> Int8[Array, "N K"]:
    """The edge status before anything was checked."""
    return jnp.zeros(roadmap.neighbors.shape, jnp.int8)


def learn_edge(
    status: Int8[Array, "N K"],
    reverse: Int[Array, "N K"],
    node: Int[Array, ""],
    slot: Int[Array, ""],
    valid: Bool[Array, ""],
) -> Int8[Array, "N K"]:
    """Notes the outcome of a check at both ends of an edge."""
    found = jnp.where(valid, VALID, INVALID).astype(jnp.int8)
    flat = status.reshape(-1).at[reverse[node, slot]].set(found)
    return flat.reshape(status.shape).at[node, slot].set(found)


class _Walk(NamedTuple):
    node: jax.Array  # where the walk stands
    visited: jax.Array  # [N]
    tried: jax.Array  # [K] slots of the current node that were refuted
    values: jax.Array  # [K] guidance values of the current node
    carry: Any
    path: jax.Array  # [N]
    steps: jax.Array  # nodes in the path
    stuck: jax.Array
    edge_checks: jax.Array
    configuration_checks: jax.Array
    status: jax.Array  # [N K]


def greedy_search(
    roadmap: Roadmap,
    scorer: Scorer,
    check_edge: Callable[[jax.Array, jax.Array], EdgeChecks],
    status: Int8[Array, "N K"] | None = None,
) -> SearchResult:
    """Walks from node to best neighbour and checks only the edges it wants to take (Algorithm 1).

    The neighbours of the current node are tried from the highest guidance value down; the first
    whose edge is valid joins the path. Nodes already on the path are not candidates (the paper's
    flags). The walk fails when no candidate is left, and never turns back.

    Args:
        roadmap: one roadmap.
        scorer: what ranks the neighbours.
        check_edge: `(q_from [D], q_to [D]) -> EdgeChecks` of scalars.
        status: what earlier searches found out; asking about a known edge costs nothing.
    """
    num, num_slots = roadmap.neighbors.shape
    reverse = reverse_slots(roadmap)
    start = jnp.int32(START)
    carry = scorer.advance(scorer.init(), start)
    zero = jnp.int32(0)
    walk = _Walk(
        node=start,
        visited=jnp.zeros(num, bool).at[START].set(True),
        tried=jnp.zeros(num_slots, bool),
        values=scorer.values(carry, start),
        carry=carry,
        path=jnp.full(num, -1, jnp.int32).at[0].set(START),
        steps=zero + 1,
        stuck=jnp.bool_(False),
        edge_checks=zero,
        configuration_checks=zero,
        status=unknown_edges(roadmap) if status is None else status,
    )

    def walking(walk: _Walk) -> jax.Array:
        return (walk.node != GOAL) & ~walk.stuck

    def try_best(walk: _Walk) -> _Walk:
        slot, open_left = _best_slot(roadmap, walk.node, walk.visited, walk.tried, walk.values)
        target = roadmap.neighbors[walk.node, slot]
        known = walk.status[walk.node, slot]
        checks = check_edge(roadmap.nodes[walk.node], roadmap.nodes[target])
        valid = jnp.where(known == UNKNOWN, checks.valid, known == VALID)
        asked = open_left & (known == UNKNOWN)
        walk = walk._replace(
            tried=walk.tried.at[slot].set(True),
            stuck=~open_left,
            edge_checks=walk.edge_checks + asked,
            configuration_checks=walk.configuration_checks + asked * checks.num_checks,
            status=jnp.where(
                asked, learn_edge(walk.status, reverse, walk.node, slot, valid), walk.status
            ),
        )

        def step(walk: _Walk) -> _Walk:
            carry = scorer.advance(walk.carry, target)
            return walk._replace(
                node=target,
                visited=walk.visited.at[target].set(True),
                tried=jnp.zeros(num_slots, bool),
                values=scorer.values(carry, target),
                carry=carry,
                path=walk.path.at[walk.steps].set(target),
                steps=walk.steps + 1,
            )

        return jax.lax.cond(open_left & valid, step, lambda walk: walk, walk)

    walk = jax.lax.while_loop(walking, try_best, walk)
    return SearchResult(
        walk.path, walk.node == GOAL, walk.edge_checks, walk.configuration_checks, walk.status
    )


def _best_slot(roadmap, node, visited, tried, values):
    """The best slot that is still open, and whether there is any."""
    is_open = roadmap.neighbor_mask[node] & ~visited[roadmap.neighbors[node]] & ~tried
    # An open slot wins over the others even if its value is minus infinity.
    lowest = jnp.finfo(values.dtype).min
    values = jnp.nan_to_num(values, nan=lowest, neginf=lowest)
    return jnp.argmax(jnp.where(is_open, values, -jnp.inf)), jnp.any(is_open)


def greedy_search_on_host(
    roadmap: Roadmap,
    scorer: Scorer,
    check_edge: Callable[[jax.Array, jax.Array], EdgeChecks],
) -> SearchResult:
    """`greedy_search` as a plain loop that can be stepped through; same paths, same counts."""
    neighbors, mask = np.asarray(roadmap.neighbors), np.asarray(roadmap.neighbor_mask)
    reverse = reverse_slots(roadmap)
    status = unknown_edges(roadmap)
    node, path, edge_checks, configuration_checks = START, [START], 0, 0
    carry = scorer.advance(scorer.init(), jnp.int32(START))
    while node != GOAL:
        values = np.nan_to_num(scorer.values(carry, jnp.int32(node)), nan=-np.inf, neginf=-np.inf)
        candidates = [k for k in range(len(values)) if mask[node, k]]
        candidates = [k for k in candidates if neighbors[node, k] not in path]
        for slot in sorted(candidates, key=lambda k: -values[k]):
            target = int(neighbors[node, slot])
            checks = check_edge(roadmap.nodes[node], roadmap.nodes[target])
            edge_checks += 1
            configuration_checks += int(checks.num_checks)
            at = jnp.int32(node), jnp.int32(slot)
            status = learn_edge(status, reverse, *at, jnp.asarray(checks.valid))
            if checks.valid:
                carry = scorer.advance(carry, jnp.int32(target))
                path.append(target)
                node = target
                break
        else:
            break
    padded = jnp.full(len(neighbors), -1, jnp.int32).at[: len(path)].set(jnp.array(path))
    return SearchResult(
        padded,
        jnp.bool_(node == GOAL),
        jnp.int32(edge_checks),
        jnp.int32(configuration_checks),
        status,
    )


def follow(roadmap: Roadmap, slots: Int[Array, " N"], cost: Float[Array, " N"]) -> Int[Array, " N"]:
    """The nodes met on the way from the start to the goal along `slots`; -1 after the last.

    Only the start if the goal's cost-to-go there is infinite.
    """
    path = jnp.full(len(slots), -1, jnp.int32).at[0].set(START)

    def walking(state):
        node, steps, _ = state
        return (node != GOAL) & jnp.isfinite(cost[START]) & (steps < len(slots))

    def step(state):
        node, steps, path = state
        node = roadmap.neighbors[node, slots[node]]
        return node, steps + 1, path.at[steps].set(node)

    return jax.lax.while_loop(walking, step, (jnp.int32(START), jnp.int32(1), path))[2]


def lazy_search(
    roadmap: Roadmap,
    check_edge: Callable[[jax.Array, jax.Array], EdgeChecks],
    status: Int8[Array, "N K"] | None = None,
    price: Float[Array, "N K"] | None = None,
) -> SearchResult:
    """Checks one edge of the cheapest path at a time, until all of a path's edges are valid.

    Without a price this is LazySP with the "forward" selector (Dellin and Srinivasa, 2016): it
    finds the roadmap's shortest valid path. With one, unlikely edges are avoided, and of a path the
    least likely edge is checked first; the path then is the cheapest by length and price together,
    where edges known to be valid cost their length alone.

    Args:
        roadmap: one roadmap.
        check_edge: `(q_from [D], q_to [D]) -> EdgeChecks` of scalars.
        status: what earlier searches found out; asking about a known edge costs nothing.
        price: what an edge costs, beside its length, while it is unknown whether it is valid.
    """
    reverse = reverse_slots(roadmap)
    status = unknown_edges(roadmap) if status is None else status
    price = jnp.zeros(roadmap.lengths.shape) if price is None else price
    zero = jnp.int32(0)

    def cheapest(status):
        edge_cost = roadmap.lengths + jnp.where(status == UNKNOWN, price, 0.0)
        edge_cost = jnp.where(status == INVALID, jnp.inf, edge_cost)
        cost = cost_to_go(roadmap, edge_cost, GOAL)
        slots = next_slots(roadmap, edge_cost, cost)
        return follow(roadmap, slots, cost), slots

    def searching(state):
        return ~state[0]

    def check_next(state):
        _, status, edge_checks, configuration_checks, _ = state
        path, slots = cheapest(status)
        slot = slots[path]  # of the last nodes, -1: whatever it is, it does not count
        on_path = (path >= 0) & (path != GOAL) & jnp.any(path == GOAL)
        unknown = on_path & (status[path, slot] == UNKNOWN)
        step = jnp.argmax(jnp.where(unknown, price[path, slot], -1.0))  # the first of the dearest
        done = ~jnp.any(unknown)
        node, chosen = path[step], slot[step]
        checks = check_edge(roadmap.nodes[node], roadmap.nodes[roadmap.neighbors[node, chosen]])
        learned = learn_edge(status, reverse, node, chosen, checks.valid)
        return (
            done,
            jnp.where(done, status, learned),
            edge_checks + ~done,
            configuration_checks + jnp.where(done, 0, checks.num_checks),
            path,
        )

    path = jnp.full(len(roadmap.nodes), -1, jnp.int32)
    state = (jnp.bool_(False), status, zero, zero, path)
    _, status, edge_checks, configuration_checks, path = jax.lax.while_loop(
        searching, check_next, state
    )
    success = jnp.any(path == GOAL)
    return SearchResult(path, success, edge_checks, configuration_checks, status)
