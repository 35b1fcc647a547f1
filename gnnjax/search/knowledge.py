"""What a search knows of the edges of a roadmap, and what it found."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Int8

from gnnjax.roadmap.graph import GOAL, START, Roadmap

# Edge status: what is known of a slot's edge. Of nodes likewise.
UNKNOWN, VALID, INVALID = 0, 1, 2


class SearchResult(NamedTuple):
    """A walk on the roadmap, and what it cost."""

    path: Int[Array, "*batch N"]  # nodes walked, start first; -1 after the last
    success: Bool[Array, "*batch"]  # the walk ends at the goal
    edge_checks: Int[Array, "*batch"]  # edges tested
    configuration_checks: Int[Array, "*batch"]  # configurations tested for them
    edge_status: Int8[Array, "*batch N K"]  # what is now known of every slot's edge


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


def nothing_known(roadmap: Roadmap, *, nodes_checked: bool = False) -> Knowledge:
    """What is known of a roadmap in the beginning."""
    num = len(roadmap.nodes)
    nodes = jnp.full(num, VALID if nodes_checked else UNKNOWN, jnp.int8)
    return Knowledge(unknown_edges(roadmap), nodes)


def ends_known(roadmap: Roadmap, *, nodes_checked: bool = False) -> Knowledge:
    """`nothing_known`, but for start and goal, which a query that is planned has valid."""
    known = nothing_known(roadmap, nodes_checked=nodes_checked)
    return known._replace(node_status=known.node_status.at[jnp.array([START, GOAL])].set(VALID))
