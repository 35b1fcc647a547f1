"""What a search knows of the edges of a roadmap, and what it found."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8

from gnnjax.guide.guide import RISK_WEIGHT
from gnnjax.roadmap.graph import GOAL, Roadmap

# Edge status: what is known of a slot's edge. Of nodes likewise.
UNKNOWN, VALID, INVALID = 0, 1, 2


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


class Knowledge(NamedTuple):
    """What is known of a roadmap."""

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
    # Where paths are shortened: points spread along the path, see `shorten.py`.
    points: Float[Array, "*batch V D"] | None = None


def nothing_known(roadmap: Roadmap, *, nodes_checked: bool = False) -> Knowledge:
    """What is known of a roadmap in the beginning."""
    num = len(roadmap.nodes)
    status = jnp.zeros(roadmap.neighbors.shape, jnp.int8)
    return Knowledge(status, jnp.full(num, int(nodes_checked), jnp.int8))


def found_by(result: SearchResult, roadmap: Roadmap) -> Found:
    """What a search found, as configurations; of a search that knows no prices, at none."""
    price = result.path_price
    if price is None:
        price = jnp.where(result.success, 0.0, jnp.inf)
    return Found(
        success=result.success,
        waypoints=roadmap.nodes[jnp.where(result.path >= 0, result.path, GOAL)],
        path=result.path,
        price=price / RISK_WEIGHT,
        edge_checks=result.edge_checks,
        configuration_checks=result.configuration_checks,
    )
