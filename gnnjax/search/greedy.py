"""Greedy search: Algorithm 1 of Diao, Chi and Wang.

What ranks the neighbours is an argument, so the network, the distance to the goal and the exact
cost-to-go run through the same code.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int8

from gnnjax.collision.edges import EdgeChecks
from gnnjax.roadmap.graph import GOAL, START, Roadmap, reverse_slots
from gnnjax.search.knowledge import UNKNOWN, VALID, SearchResult, learn_edge, unknown_edges


class Scorer(NamedTuple):
    """What ranks the neighbours of the node a search stands at.

    `init() -> carry`; `advance(carry, node) -> carry` when a node joins the path, the start
    included; `values(carry, node) -> [K]` guidance values of the node's slots, higher is better.
    """

    init: Callable[[], Any]
    advance: Callable[[Any, jax.Array], Any]
    values: Callable[[Any, jax.Array], jax.Array]


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
