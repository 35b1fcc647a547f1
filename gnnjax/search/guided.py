"""The parts of the guided search: price and search a roadmap, shorten a path and check it.

The guide's opinion costs no check. So the cheapest path in its eyes is found first, then shortened
in its eyes, and only then checked. If that does not hold, the roadmap is searched lazily to the
end: a path is found wherever the roadmap has one. The strategy "guided" puts the parts together.
"""

from collections.abc import Callable

import jax
from jaxtyping import Array, Bool, Float, Int, Int8

from gnnjax.collision.checker import EdgeChecks
from gnnjax.guide.guide import RISK_WEIGHT, Prices
from gnnjax.roadmap.graph import GOAL, Roadmap
from gnnjax.roadmap.paths import for_each_edge
from gnnjax.search.knowledge import Found, Knowledge, found_by
from gnnjax.search.lazy import lazy_search
from gnnjax.search.shorten import PATH_POINTS, search_shortened, shortened, spread_evenly

# Most pieces that a motion is looked at in; the longest edge is that from start to goal.
_EDGE_PIECES, _SHORTCUT_PIECES, _ALL_PIECES = 16, 12, 8

CheckEdge = Callable[[jax.Array, jax.Array], EdgeChecks]  # `(q_from [D], q_to [D])`, ends apart
CheckNodes = Callable[[jax.Array], Bool[Array, " B"]]  # `[B D] -> [B]`, true where valid


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
    points = spread_evenly(found.path, roadmap.nodes, PATH_POINTS)
    return (
        found_by(found, roadmap)._replace(points=points),
        Knowledge(found.edge_status, found.node_status),
    )


def shorten_guided(
    points: Float[Array, "V D"],
    prices: Prices,
    check_edge: CheckEdge,
    check_nodes: CheckNodes,
    status: Int8[Array, "V V"],
) -> tuple[Found, Int8[Array, "V V"]]:
    """Shortens a path in the guide's eyes, then checks it.

    Args:
        points: spread along the path, from `spread_evenly`.
        prices: of motions, nats.
        check_edge: tests an edge.
        check_nodes: tests nodes.
        status: what is known of the edges of the path roadmap, 0 in the beginning.

    Returns:
        The path, and what is now known; both are about nodes of the path roadmap.
    """
    roadmap, price = shortened(points, _motion_price(prices, _SHORTCUT_PIECES))
    found = search_shortened(roadmap, price, check_edge, check_nodes, status)
    return found_by(found, roadmap), found.edge_status


def _motion_price(prices: Prices, pieces: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
    return lambda starts, ends: RISK_WEIGHT * prices.motions(starts, ends, pieces)
