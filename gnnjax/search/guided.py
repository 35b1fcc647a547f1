"""The parts of the guided search: price and search a roadmap, shorten a path and check it.

The network's opinion costs no check. So the cheapest path in its eyes is found first, then
shortened in its eyes, and only then checked. If that does not hold, the roadmap is searched lazily
to the end: a path is found wherever the roadmap has one. `guided_planner.py` puts the parts
together.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8

from gnnjax.collision.checker import EdgeChecks
from gnnjax.guide.guide import RISK_WEIGHT, Prices
from gnnjax.roadmap.graph import GOAL, Roadmap
from gnnjax.roadmap.paths import for_each_edge
from gnnjax.search.knowledge import SearchResult
from gnnjax.search.lazy import lazy_search
from gnnjax.search.shorten import NUM_POINTS, search_shortened, shortened, spread_evenly

# Most pieces that a motion is looked at in; the longest edge is that from start to goal.
_EDGE_PIECES, _SHORTCUT_PIECES, _ALL_PIECES = 16, 12, 8

CheckEdge = Callable[[jax.Array, jax.Array], EdgeChecks]  # `(q_from [D], q_to [D])`, ends apart
CheckNodes = Callable[[jax.Array], Bool[Array, " B"]]  # `[B D] -> [B]`, true where valid


class Knowledge(NamedTuple):
    """What is known of a roadmap; see `search.py`."""

    status: Int8[Array, "*batch N K"]
    node_status: Int8[Array, "*batch N"]


class Found(NamedTuple):
    """A path, and what finding it cost."""

    success: Bool[Array, "*batch"]  # there is a path; checked, if it is short enough to be
    waypoints: Float[Array, "*batch N D"]  # from start to goal; the goal again after the last
    path: Int[Array, "*batch N"]  # nodes; -1 after the last
    price: Float[Array, "*batch"]  # nats, of what is not checked; inf without a path
    edge_checks: Int[Array, "*batch"]
    configuration_checks: Int[Array, "*batch"]
    points: Float[Array, "*batch V D"]  # spread along the path, see `shorten.py`


def nothing_known(roadmap: Roadmap, *, nodes_checked: bool = False) -> Knowledge:
    """What is known of a roadmap in the beginning."""
    num = len(roadmap.nodes)
    status = jnp.zeros(roadmap.neighbors.shape, jnp.int8)
    return Knowledge(status, jnp.full(num, int(nodes_checked), jnp.int8))


def search_guided(
    roadmap: Roadmap,
    prices: Prices,
    check_edge: CheckEdge,
    check_nodes: CheckNodes,
    knowledge: Knowledge,
    longest_checked: Int[Array, ""],
    max_price: Float[Array, ""],
    *,
    price_all: bool,
) -> tuple[Found, Knowledge]:
    """Finds the path that is cheapest by length and price, and checks it if it is short.

    Args:
        roadmap: one roadmap, whose nodes need not be valid.
        prices: of configurations and motions, nats.
        check_edge: tests an edge.
        check_nodes: tests nodes.
        knowledge: from earlier searches; asking about what is known costs nothing.
        longest_checked: most edges of a path that is checked; a longer one is returned as it is.
        max_price: give up when the cheapest path has a higher price, nats.
        price_all: look at all edges first, not at those alone that the search comes to. Quicker
            where it will come to most of them.
    """
    motion_price = _motion_price(prices, _ALL_PIECES if price_all else _EDGE_PIECES)
    if price_all:
        price = for_each_edge(roadmap, motion_price)
    else:
        at_node = RISK_WEIGHT * prices.nodes(roadmap.nodes)
        at_node = at_node.at[: GOAL + 1].set(0.0)  # start and goal are valid
        price = (at_node[:, None] + at_node[roadmap.neighbors]) / 2
    found = lazy_search(
        roadmap,
        check_edge,
        knowledge.status,
        price,
        judge=None if price_all else motion_price,
        check_nodes=check_nodes,
        node_status=knowledge.node_status,
        longest_checked=longest_checked,
        max_price=RISK_WEIGHT * max_price,
    )
    assert found.node_status is not None
    return _found(roadmap, found), Knowledge(found.edge_status, found.node_status)


def shorten_guided(
    points: Float[Array, "V D"],
    prices: Prices,
    check_edge: CheckEdge,
    check_nodes: CheckNodes,
    status: Int8[Array, "V V"],
) -> tuple[Found, Int8[Array, "V V"]]:
    """Shortens a path in the network's eyes, then checks it.

    Args:
        points: spread along the path, from `Found`.
        prices: of motions, nats.
        check_edge: tests an edge.
        check_nodes: tests nodes.
        status: what is known of the edges of the path roadmap, 0 in the beginning.

    Returns:
        The path, and what is now known; both are about nodes of the path roadmap.
    """
    roadmap, price = shortened(points, _motion_price(prices, _SHORTCUT_PIECES))
    found = search_shortened(roadmap, price, check_edge, check_nodes, status)
    return _found(roadmap, found), found.edge_status


def _motion_price(prices: Prices, pieces: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
    return lambda starts, ends: RISK_WEIGHT * prices.motions(starts, ends, pieces)


def _found(roadmap: Roadmap, found: SearchResult) -> Found:
    assert found.path_price is not None
    return Found(
        success=found.success,
        waypoints=roadmap.nodes[jnp.where(found.path >= 0, found.path, GOAL)],
        path=found.path,
        price=found.path_price / RISK_WEIGHT,
        edge_checks=found.edge_checks,
        configuration_checks=found.configuration_checks,
        points=spread_evenly(found.path, roadmap.nodes, NUM_POINTS),
    )
