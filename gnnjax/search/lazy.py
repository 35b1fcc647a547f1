"""Lazy search: LazySP (Dellin and Srinivasa, 2016), with prices for unchecked edges."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int8

from gnnjax.collision.edges import EdgeChecks
from gnnjax.roadmap.graph import GOAL, START, Roadmap, reverse_slots
from gnnjax.roadmap.paths import cost_to_go, follow, next_slots
from gnnjax.search.knowledge import INVALID, UNKNOWN, SearchResult, learn_edge, unknown_edges


class _Lazy(NamedTuple):
    """What a lazy search knows."""

    done: jax.Array
    path: jax.Array  # [N] the cheapest by what is known; -1 after the last
    status: jax.Array  # [N K]
    edge_checks: jax.Array
    configuration_checks: jax.Array


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
    where edges known to be valid cost their length alone. It fails only where the roadmap has no
    valid path.

    Args:
        roadmap: one roadmap.
        check_edge: `(q_from [D], q_to [D]) -> EdgeChecks` of scalars, ends apart.
        status: what earlier searches found out; asking about a known edge costs nothing.
        price: what an edge costs, beside its length, while it is unknown whether it is valid.
    """
    doubts = jnp.zeros(roadmap.lengths.shape) if price is None else price
    reverse = reverse_slots(roadmap)
    first = _Lazy(
        done=jnp.bool_(False),
        path=jnp.full(len(roadmap.nodes), -1, jnp.int32),
        status=unknown_edges(roadmap) if status is None else status,
        edge_checks=jnp.int32(0),
        configuration_checks=jnp.int32(0),
    )

    def go_on(lazy: _Lazy) -> _Lazy:
        own_price = jnp.where(lazy.status == UNKNOWN, doubts, 0.0)
        edge_cost = jnp.where(lazy.status == INVALID, jnp.inf, roadmap.lengths + own_price)
        cost = cost_to_go(roadmap, edge_cost, GOAL, START)
        slots = next_slots(roadmap, edge_cost, cost)
        path = follow(roadmap, slots, cost)
        node = jnp.maximum(path, 0)
        slot = slots[node]
        on_path = (path >= 0) & (path != GOAL) & jnp.any(path == GOAL)
        unknown = on_path & (lazy.status[node, slot] == UNKNOWN)

        def test_edge(lazy: _Lazy) -> _Lazy:
            # The first of the dearest.
            step = jnp.argmax(jnp.where(unknown, doubts[node, slot], -1.0))
            at, through = node[step], slot[step]
            checks = check_edge(roadmap.nodes[at], roadmap.nodes[roadmap.neighbors[at, through]])
            return lazy._replace(
                status=learn_edge(lazy.status, reverse, at, through, checks.valid),
                edge_checks=lazy.edge_checks + 1,
                configuration_checks=lazy.configuration_checks + checks.num_checks,
            )

        def end(lazy: _Lazy) -> _Lazy:
            return lazy._replace(done=jnp.bool_(True))

        return jax.lax.cond(jnp.any(unknown), test_edge, end, lazy._replace(path=path))

    lazy = jax.lax.while_loop(lambda lazy: ~lazy.done, go_on, first)
    return SearchResult(
        lazy.path,
        jnp.any(lazy.path == GOAL),
        lazy.edge_checks,
        lazy.configuration_checks,
        lazy.status,
    )
