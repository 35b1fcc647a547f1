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

from gnnjax.collision.checker import EdgeChecks
from gnnjax.paper.encoding import Encoding
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.roadmap.graph import Roadmap, reverse_slots
from gnnjax.roadmap.paths import cost_to_go, next_slots

START, GOAL = 0, 1

# Edge status: what is known of a slot's edge. Of nodes likewise.
UNKNOWN, VALID, INVALID = 0, 1, 2

_BATCH = 16  # edges that are looked at, and nodes that are tested, at once


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
    # Of a lazy search alone: what is known of the nodes, and the price of the path at its end, or
    # of the one it gave up at; inf where there is no path.
    node_status: Int8[Array, "*batch N"] | None = None
    path_price: Float[Array, "*batch"] | None = None


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


class _Lazy(NamedTuple):
    """What a lazy search knows."""

    done: jax.Array
    path: jax.Array  # [N] the cheapest by what is known; -1 after the last
    path_price: jax.Array  # its price, inf without a path
    price: jax.Array  # [N K]
    judged: jax.Array  # [N K] edges whose price is final
    status: jax.Array  # [N K]
    node_status: jax.Array  # [N]
    edge_checks: jax.Array
    configuration_checks: jax.Array


def lazy_search(
    roadmap: Roadmap,
    check_edge: Callable[[jax.Array, jax.Array], EdgeChecks],
    status: Int8[Array, "N K"] | None = None,
    price: Float[Array, "N K"] | None = None,
    *,
    judge: Callable[[jax.Array, jax.Array], jax.Array] | None = None,
    judged: bool | Bool[Array, ""] = False,
    check_nodes: Callable[[jax.Array], jax.Array] | None = None,
    node_status: Int8[Array, " N"] | None = None,
    longest_checked: int | Int[Array, ""] | None = None,
    max_price: float | Float[Array, ""] = jnp.inf,
    max_edge_checks: int | None = None,
) -> SearchResult:
    """Checks one edge of the cheapest path at a time, until all of a path's edges are valid.

    Without a price this is LazySP with the "forward" selector (Dellin and Srinivasa, 2016): it
    finds the roadmap's shortest valid path. With one, unlikely edges are avoided, and of a path the
    least likely edge is checked first; the path then is the cheapest by length and price together,
    where edges known to be valid cost their length alone. It fails only where the roadmap has no
    valid path, or where a limit stops it.

    Args:
        roadmap: one roadmap.
        check_edge: `(q_from [D], q_to [D]) -> EdgeChecks` of scalars, ends apart.
        status: what earlier searches found out; asking about a known edge costs nothing.
        price: what an edge costs, beside its length, while it is unknown whether it is valid.
        judge: `(starts [B D], ends [B D]) -> [B]`, a closer look at the price of edges. It is taken
            once, when an edge lies on a cheapest path, before anything of that path is checked.
        judged: all edges had their closer look already.
        check_nodes: `[B D] -> [B]`, true where valid. The nodes of a path are checked before its
            edges; a node that is not valid takes its edges with it. None: all nodes are valid.
        node_status: what is known of the nodes, like `status`; start and goal are always valid.
        longest_checked: a path of more edges is not checked: the search ends with the one that is
            cheapest after a closer look. None: any path is checked.
        max_price: give up when the cheapest path's price exceeds this.
        max_edge_checks: give up after so many.
    """
    num, num_slots = roadmap.neighbors.shape
    reverse = reverse_slots(roadmap)
    batch = min(_BATCH, num)
    if node_status is None:
        node_status = jnp.full(num, VALID if check_nodes is None else UNKNOWN, jnp.int8)
    node_status = node_status.at[jnp.array([START, GOAL])].set(VALID)
    first = _Lazy(
        done=jnp.bool_(False),
        path=jnp.full(num, -1, jnp.int32),
        path_price=jnp.float32(jnp.inf),
        price=jnp.zeros(roadmap.lengths.shape) if price is None else price,
        judged=jnp.full(roadmap.lengths.shape, judged if judge is not None else True),
        status=unknown_edges(roadmap) if status is None else status,
        node_status=node_status,
        edge_checks=jnp.int32(0),
        configuration_checks=jnp.int32(0),
    )

    def look_closer(lazy: _Lazy, node: jax.Array, slot: jax.Array, wanted: jax.Array) -> _Lazy:
        assert judge is not None
        (step,) = jnp.nonzero(wanted, size=batch, fill_value=-1)
        at, through = node[step], slot[step]
        target = roadmap.neighbors[at, through]
        found = judge(roadmap.nodes[at], roadmap.nodes[target])
        outside = num * num_slots  # dropped
        ways = at * num_slots + through, reverse[at, through]
        price, judged = lazy.price.ravel(), lazy.judged.ravel()
        for way in ways:
            way = jnp.where(step >= 0, way, outside)
            price = price.at[way].set(found, mode="drop")
            judged = judged.at[way].set(True, mode="drop")
        shape = lazy.price.shape
        return lazy._replace(price=price.reshape(shape), judged=judged.reshape(shape))

    def test_nodes(lazy: _Lazy, wanted: jax.Array) -> _Lazy:
        assert check_nodes is not None
        (step,) = jnp.nonzero(wanted, size=batch, fill_value=-1)
        node = lazy.path[step]
        valid = check_nodes(roadmap.nodes[node])
        bad = (step >= 0) & ~valid
        refuted = jnp.any(bad)
        last = jnp.where(refuted, jnp.argmax(bad), batch)  # what a sequential test stops at
        tested = (step >= 0) & (jnp.arange(batch) <= last)
        found = jnp.where(valid, VALID, INVALID).astype(jnp.int8)
        culprit = node[jnp.minimum(last, batch - 1)]
        row = jnp.where(refuted, culprit, num)  # dropped
        status = lazy.status.at[row].set(INVALID, mode="drop").ravel()
        back = jnp.where(refuted, reverse[culprit], num * num_slots)
        return lazy._replace(
            node_status=lazy.node_status.at[jnp.where(tested, node, num)].set(found, mode="drop"),
            status=status.at[back].set(INVALID, mode="drop").reshape(lazy.status.shape),
            configuration_checks=lazy.configuration_checks + tested.sum(),
        )

    def test_edge(lazy: _Lazy, node: jax.Array, slot: jax.Array, wanted: jax.Array) -> _Lazy:
        # The first of the dearest.
        step = jnp.argmax(jnp.where(wanted, lazy.price[node, slot], -1.0))
        at, through = node[step], slot[step]
        checks = check_edge(roadmap.nodes[at], roadmap.nodes[roadmap.neighbors[at, through]])
        return lazy._replace(
            status=learn_edge(lazy.status, reverse, at, through, checks.valid),
            edge_checks=lazy.edge_checks + 1,
            configuration_checks=lazy.configuration_checks + checks.num_checks,
        )

    def go_on(lazy: _Lazy) -> _Lazy:
        price = jnp.where(lazy.status == UNKNOWN, lazy.price, 0.0)
        edge_cost = jnp.where(lazy.status == INVALID, jnp.inf, roadmap.lengths + price)
        cost = cost_to_go(roadmap, edge_cost, GOAL, START)
        slots = next_slots(roadmap, edge_cost, cost)
        path = follow(roadmap, slots, cost)
        node = jnp.maximum(path, 0)
        slot = slots[node]
        on_path = (path >= 0) & (path != GOAL) & jnp.any(path == GOAL)
        unknown = on_path & (lazy.status[node, slot] == UNKNOWN)
        unjudged = unknown & ~lazy.judged[node, slot]
        untested = (path >= 0) & (lazy.node_status[node] == UNKNOWN)
        path_price = jnp.where(
            jnp.any(path == GOAL), jnp.sum(price[node, slot], where=on_path), jnp.inf
        )
        # In this order: what costs nothing, what costs one check, and what costs many.
        todo = [jnp.any(unjudged), jnp.any(untested), jnp.any(unknown)]
        if longest_checked is not None:
            checking = jnp.sum(path >= 0) - 1 <= longest_checked
            todo[1:] = [work & checking for work in todo[1:]]
        too_much = path_price > max_price
        if max_edge_checks is not None:
            too_much |= lazy.edge_checks >= max_edge_checks
        stop = ~todo[0] & too_much & (todo[1] | todo[2])
        choices: list[Callable[[_Lazy], _Lazy]] = [
            (lambda x: x) if judge is None else (lambda x: look_closer(x, node, slot, unjudged)),
            (lambda x: x) if check_nodes is None else (lambda x: test_nodes(x, untested)),
            lambda x: test_edge(x, node, slot, unknown),
            lambda x: x._replace(done=jnp.bool_(True)),
        ]
        # Given up: the path stays, and what it lacks is what makes it no success.
        todo = jnp.where(stop, False, jnp.stack(todo))
        choice = jnp.where(jnp.any(todo), jnp.argmax(todo), len(choices) - 1)
        known = lazy._replace(path=jnp.where(stop, -1, path), path_price=path_price)
        return jax.lax.switch(choice, choices, known)

    lazy = jax.lax.while_loop(lambda lazy: ~lazy.done, go_on, first)
    return SearchResult(
        lazy.path,
        jnp.any(lazy.path == GOAL),
        lazy.edge_checks,
        lazy.configuration_checks,
        lazy.status,
        lazy.node_status,
        lazy.path_price,
    )
