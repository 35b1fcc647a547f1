"""Roadmaps: r-disc random geometric graphs with K slots a node."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.robot import Robot

# Padded numbers of nodes; one compilation each.
NODE_BUCKETS = (200, 400, 600, 800, 1000, 1500, 2000, 3000, 5000)


START, GOAL = 0, 1  # nodes of every roadmap
# Configuration units. Nodes nearer to each other are not joined, but for start and goal: rounded,
# either may be as cheap to go on from as the other, and a search would go in circles.
SHORTEST = 1e-4


class Roadmap(NamedTuple):
    """A padded random geometric graph. Node 0 is the start, node 1 the goal.

    The graph is undirected and stored both ways: v is in a slot of u if and only if u is in a slot
    of v.
    """

    nodes: Float[Array, "*batch N D"]  # configurations, rad or m by joint
    node_mask: Bool[Array, "*batch N"]  # false on padding
    neighbors: Int[Array, "*batch N K"]  # node in each slot; the node itself on padding
    neighbor_mask: Bool[Array, "*batch N K"]  # true where the slot holds an edge
    lengths: Float[Array, "*batch N K"]  # edge cost, Euclidean; 0 on padding
    num_dropped: Int[Array, "*batch"]  # edges within the radius left out for lack of slots


def node_bucket(num_nodes: int) -> int:
    """The padded number of nodes of a roadmap."""
    for bucket in NODE_BUCKETS:
        if num_nodes <= bucket:
            return bucket
    return -(-num_nodes // 1000) * 1000


def default_mean_degree(num_nodes: int) -> float:
    """Mean number of neighbours a node: 2.4 ln N, so 12.7 at N = 200 and 16.6 at N = 1000.

    It grows with ln N as asymptotic optimality asks (Karaman and Frazzoli, 2011); the factor keeps
    start and goal connected on 98 % of the public Kuka problems.
    """
    return 2.4 * float(np.log(num_nodes))


def default_slots(num_nodes: int) -> int:
    """Slots a node, K: nodes in the middle of the space have up to four times the mean degree."""
    return 8 * int(np.ceil(4.0 * default_mean_degree(num_nodes) / 8))


@functools.cache
def radius_for_degree(robot: Robot, num_nodes: int, mean_degree: float) -> float:
    """The r-disc radius that gives uniform nodes a mean degree, in configuration units.

    The share of node pairs nearer than r is measured on pairs drawn once where nodes are, which
    takes the boundary into account; in seven dimensions most nodes are near it, and the
    volume of a ball would give a degree several times too large.
    """
    share = min(1.0, mean_degree / max(1, num_nodes - 1))
    return float(np.quantile(_pair_distances(robot), share))


@functools.lru_cache(maxsize=2)  # of 4 MB each
def _pair_distances(robot: Robot) -> np.ndarray:
    generator = np.random.default_rng(0)
    pairs = generator.random((2, 500_000, robot.num_dof))
    pairs *= robot.drawn_upper - robot.drawn_lower
    return np.linalg.norm(pairs[0] - pairs[1], axis=1)


def default_radius(robot: Robot, num_nodes: int) -> float:
    """The r-disc radius of the default mean degree, in configuration units."""
    return radius_for_degree(robot, num_nodes, default_mean_degree(num_nodes))


def connect(
    nodes: Float[Array, "N D"],
    node_mask: Bool[Array, " N"],
    radius: float | Float[Array, ""],
    num_slots: int,
) -> Roadmap:
    """Connects all pairs of nodes at most `radius` apart.

    A node with more neighbours than slots keeps the nearest, and the others forget it too.

    Args:
        nodes: configurations; 0 is the start, 1 the goal.
        node_mask: false on padding.
        radius: largest length of an edge, configuration units.
        num_slots: K.
    """

    def within(squared: jax.Array) -> jax.Array:
        return (squared <= jnp.square(radius)) & ~jnp.eye(len(nodes), dtype=bool)

    return connect_where(nodes, node_mask, within, num_slots)


def connect_where(
    nodes: Float[Array, "N D"],
    node_mask: Bool[Array, " N"],
    joined: Callable[[Float[Array, "N N"]], Bool[Array, "N N"]],
    num_slots: int,
) -> Roadmap:
    """Connects the pairs of nodes that a rule names, if they are not in one place.

    A node with more neighbours than slots keeps the nearest, and the others forget it too.

    Args:
        nodes: configurations; 0 is the start, 1 the goal.
        node_mask: false on padding.
        joined: from all squared distances to the pairs, symmetric, no node with itself.
        num_slots: K.
    """
    num = len(nodes)
    # Differences rather than a matrix product: exactly symmetric, and no cancellation.
    squared = sum((nodes[:, None, d] - nodes[None, :, d]) ** 2 for d in range(nodes.shape[1]))
    squared = jnp.asarray(squared)
    apart = (squared > SHORTEST**2).at[[START, GOAL], [GOAL, START]].set(True)
    within = node_mask[:, None] & node_mask[None, :] & joined(squared) & apart
    num_slots = min(num_slots, num)
    # Without the barrier XLA:CPU takes this for a full sort once its results are used, which is
    # eighteen times slower at a thousand nodes.
    negative, neighbors = jax.lax.optimization_barrier(
        jax.lax.top_k(jnp.where(within, -squared, -jnp.inf), num_slots)
    )
    degree = within.sum(axis=1)
    own = jnp.arange(num)[:, None]
    # Both must keep each other. Distances alone do not tell: of two nodes equally far, one may have
    # the last slot.
    kept = jnp.zeros((num, num), bool).at[own, neighbors].set(jnp.isfinite(negative))
    mask = jnp.isfinite(negative) & kept[neighbors, own]
    lengths = jnp.sqrt(jnp.where(mask, -negative, 0.0))
    return Roadmap(
        nodes=nodes,
        node_mask=node_mask,
        neighbors=jnp.where(mask, neighbors, own).astype(jnp.int32),
        neighbor_mask=mask,
        lengths=lengths,
        num_dropped=((degree.sum() - mask.sum()) // 2).astype(jnp.int32),
    )


class EachEdge(NamedTuple):
    """The edges of a roadmap, each once, from its node of the lower number."""

    first: Int[np.ndarray, " E"]  # the node of the lower number
    second: Int[np.ndarray, " E"]
    slot: Int[np.ndarray, " E"]  # of the first node


def each_edge(roadmap: Roadmap) -> EachEdge:
    """Lists the edges of a roadmap, each once."""
    neighbors, mask = np.asarray(roadmap.neighbors), np.asarray(roadmap.neighbor_mask)
    first, slot = np.nonzero(mask & (np.arange(len(neighbors))[:, None] < neighbors))
    return EachEdge(first, neighbors[first, slot], slot)


def edge_numbers(roadmap: Roadmap, edges: EachEdge) -> Int[np.ndarray, "N K"]:
    """The number of the edge in each slot, by `each_edge`; E on padding."""
    neighbors, num = np.asarray(roadmap.neighbors), len(edges.first)
    table = np.full((len(neighbors), len(neighbors)), num, np.int32)
    table[edges.first, edges.second] = table[edges.second, edges.first] = np.arange(num)
    own = np.arange(len(neighbors))[:, None]
    return np.where(roadmap.neighbor_mask, table[own, neighbors], num).astype(np.int32)


def reverse_slots(roadmap: Roadmap) -> Int[Array, "N K"]:
    """For each slot, the flat index (node * K + slot) of the same edge seen from its other end."""
    num, num_slots = roadmap.neighbors.shape
    own = jnp.broadcast_to(jnp.arange(num)[:, None], roadmap.neighbors.shape)
    # Padding slots lead to their own node and would overwrite the entry of none but that.
    slot = jnp.broadcast_to(jnp.arange(num_slots), roadmap.neighbors.shape)
    table = jnp.zeros((num, num), jnp.int32).at[own, roadmap.neighbors].set(slot)
    return roadmap.neighbors * num_slots + table[roadmap.neighbors, own]
