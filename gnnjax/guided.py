"""The guided search of one roadmap: price, search, shorten, check.

The network's opinion costs no check. So the cheapest path in its eyes is found first, then
shortened in its eyes, and only then checked. If that does not hold, the roadmap is searched lazily
to the end: a path is found wherever the roadmap has one.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8

from gnnjax.collision import EdgeChecks
from gnnjax.motion import RISK_WEIGHT, Prices
from gnnjax.roadmap import Roadmap
from gnnjax.search import GOAL, SearchResult, lazy_search
from gnnjax.shorten import NUM_POINTS, search_shortened, shortened

_EDGE_PIECES = 16  # most pieces that an edge is looked at in
_SHORTCUT_PIECES = 8
ROUNDS = 2  # a trusting one and a checking one


class Knowledge(NamedTuple):
    """What is known of a roadmap and of the path roadmaps made from it; see `search.py`."""

    status: Int8[Array, "*batch N K"]
    node_status: Int8[Array, "*batch N"]
    shortcuts: Int8[Array, "*batch R V V"]  # of the path roadmaps, one a round


class Guided(NamedTuple):
    """What a guided search found, and what it cost."""

    success: Bool[Array, "*batch"]
    waypoints: Float[Array, "*batch N D"]  # from start to goal; the goal again after the last
    path: Int[Array, "*batch N"]  # nodes of the roadmap or path roadmap; -1 after the last
    shortened: Int[Array, "*batch"]  # round whose path roadmap `path` is of; -1: the roadmap itself
    # Price of the best path in nats, in whose face the search gave up; inf where there is none.
    path_price: Float[Array, "*batch"]
    edge_checks: Int[Array, "*batch"]
    configuration_checks: Int[Array, "*batch"]
    knowledge: Knowledge


def nothing_known(num_nodes: int, num_slots: int, *, nodes_checked: bool = False) -> Knowledge:
    """What is known of a roadmap in the beginning."""
    return Knowledge(
        jnp.zeros((num_nodes, num_slots), jnp.int8),
        jnp.full(num_nodes, int(nodes_checked), jnp.int8),
        jnp.zeros((ROUNDS, NUM_POINTS, NUM_POINTS), jnp.int8),
    )


def guided_search(
    roadmap: Roadmap,
    prices: Prices,
    check_edge: Callable[[jax.Array, jax.Array], EdgeChecks],
    check_nodes: Callable[[jax.Array], Bool[Array, " B"]],
    knowledge: Knowledge,
    max_price: Float[Array, ""],
    *,
    shorten: bool = True,
) -> Guided:
    """Searches one roadmap.

    Args:
        roadmap: one roadmap, whose nodes need not be valid.
        prices: of configurations and motions, nats.
        check_edge: `(q_from [D], q_to [D]) -> EdgeChecks` of scalars, ends apart.
        check_nodes: `[B D] -> [B]`, true where valid.
        knowledge: from earlier searches; asking about what is known costs nothing.
        max_price: give up when the cheapest path has a higher price, nats.
        shorten: shorten paths.
    """

    def motion_price(pieces: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
        return lambda starts, ends: RISK_WEIGHT * prices.motions(starts, ends, pieces)

    at_node = RISK_WEIGHT * prices.nodes(roadmap.nodes)
    at_node = at_node.at[: GOAL + 1].set(0.0)  # start and goal are valid
    price = (at_node[:, None] + at_node[roadmap.neighbors]) / 2

    def search(trust: jax.Array | bool, known: Knowledge) -> SearchResult:
        return lazy_search(
            roadmap,
            check_edge,
            known.status,
            price,
            judge=motion_price(_EDGE_PIECES),
            check_nodes=check_nodes,
            node_status=known.node_status,
            trust=trust,
            max_price=RISK_WEIGHT * max_price,
        )

    if not shorten:
        found = search(False, knowledge)
        return _result(
            roadmap,
            found,
            knowledge._replace(status=found.edge_status, node_status=found.node_status),
        )

    def play_round(state: tuple[jax.Array, Guided]) -> tuple[jax.Array, Guided]:
        number, sofar = state
        known = sofar.knowledge
        found = search(number == 0, known)
        known = known._replace(status=found.edge_status, node_status=found.node_status)
        plain = _result(roadmap, found, known)
        plain = plain._replace(
            success=plain.success & (number > 0),  # a trusted path is none yet
            edge_checks=sofar.edge_checks + plain.edge_checks,
            configuration_checks=sofar.configuration_checks + plain.configuration_checks,
        )

        def try_shorter() -> Guided:
            small, small_price = shortened(
                found.path, roadmap.nodes, motion_price(_SHORTCUT_PIECES)
            )
            short = search_shortened(
                small, small_price, check_edge, check_nodes, known.shortcuts[number]
            )
            merged = plain._replace(
                edge_checks=plain.edge_checks + short.edge_checks,
                configuration_checks=plain.configuration_checks + short.configuration_checks,
                knowledge=known._replace(
                    shortcuts=known.shortcuts.at[number].set(short.edge_status)
                ),
            )
            path = jnp.full_like(found.path, -1).at[:NUM_POINTS].set(short.path)
            better = merged._replace(
                success=jnp.bool_(True),
                path=path,
                waypoints=small.nodes[jnp.where(path >= 0, path, GOAL)],
                shortened=number,
            )
            shorter = short.success & (_length(better.waypoints) < _length(plain.waypoints))
            return jax.tree.map(lambda a, b: jnp.where(shorter, a, b), better, merged)

        # A path of one edge is as short as can be, and one that is hardly free not worth it.
        worth_it = jnp.any(found.path == GOAL) & (found.path[1] != GOAL)
        worth_it &= found.path_price <= RISK_WEIGHT * max_price
        return number + 1, jax.lax.cond(worth_it, try_shorter, lambda: plain)

    num, dof = roadmap.nodes.shape
    zero = jnp.int32(0)
    nothing = Guided(
        success=jnp.bool_(False),
        waypoints=jnp.zeros((num, dof)),
        path=jnp.full(num, -1, jnp.int32),
        shortened=jnp.int32(-1),
        path_price=jnp.float32(jnp.inf),
        edge_checks=zero,
        configuration_checks=zero,
        knowledge=knowledge,
    )
    return jax.lax.while_loop(
        lambda state: (state[0] < ROUNDS) & ~state[1].success, play_round, (zero, nothing)
    )[1]


def _result(roadmap: Roadmap, found: SearchResult, known: Knowledge) -> Guided:
    assert found.path_price is not None
    return Guided(
        success=found.success,
        waypoints=roadmap.nodes[jnp.where(found.path >= 0, found.path, GOAL)],
        path=found.path,
        shortened=jnp.int32(-1),
        path_price=found.path_price / RISK_WEIGHT,
        edge_checks=found.edge_checks,
        configuration_checks=found.configuration_checks,
        knowledge=known,
    )


def _length(waypoints: Float[Array, "N D"]) -> Float[Array, ""]:
    return jnp.sum(jnp.linalg.norm(jnp.diff(waypoints, axis=0), axis=-1))
