"""Lazy search: LazySP (Dellin and Srinivasa, 2016), with prices for unchecked edges."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8

from gnnjax.collision.edges import EdgeChecks
from gnnjax.roadmap.graph import GOAL, START, Roadmap, reverse_slots
from gnnjax.roadmap.paths import cost_to_go, follow, next_slots
from gnnjax.search.knowledge import (
    INVALID,
    UNKNOWN,
    VALID,
    SearchResult,
    learn_edge,
    unknown_edges,
)

_BATCH = 16  # edges that are looked at, and nodes that are tested, at once


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
