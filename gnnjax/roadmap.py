"""Roadmaps: r-disc random geometric graphs with K slots a node."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jraph
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.robot import Robot

# Padded numbers of nodes; one compilation each.
NODE_BUCKETS = (200, 400, 600, 800, 1000, 1500, 2000, 3000, 5000)


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

    The share of node pairs nearer than r is measured on pairs drawn once between the joint limits,
    which takes the boundary into account; in seven dimensions most nodes are near it, and the
    volume of a ball would give a degree several times too large.
    """
    generator = np.random.default_rng(0)
    pairs = generator.random((2, 500_000, robot.num_dof)) * robot.joint_range
    distances = np.linalg.norm(pairs[0] - pairs[1], axis=1)
    return float(np.quantile(distances, min(1.0, mean_degree / max(1, num_nodes - 1))))


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
    num = len(nodes)
    # Differences rather than a matrix product: exactly symmetric, and no cancellation.
    squared = sum((nodes[:, None, d] - nodes[None, :, d]) ** 2 for d in range(nodes.shape[1]))
    pair = node_mask[:, None] & node_mask[None, :] & ~jnp.eye(num, dtype=bool)
    within = pair & (squared <= jnp.square(radius))
    num_slots = min(num_slots, num)
    negative, neighbors = jax.lax.top_k(jnp.where(within, -squared, -jnp.inf), num_slots)
    degree = within.sum(axis=1)
    # What a node with too many neighbours reaches; the others must respect it.
    reach = jnp.where(degree > num_slots, -negative[:, -1], jnp.inf)
    own = jnp.arange(num)[:, None]
    mask = jnp.isfinite(negative) & (-negative <= reach[neighbors]) & (-negative <= reach[:, None])
    lengths = jnp.sqrt(jnp.where(mask, -negative, 0.0))
    return Roadmap(
        nodes=nodes,
        node_mask=node_mask,
        neighbors=jnp.where(mask, neighbors, own).astype(jnp.int32),
        neighbor_mask=mask,
        lengths=lengths,
        num_dropped=((degree.sum() - mask.sum()) // 2).astype(jnp.int32),
    )


def reverse_slots(roadmap: Roadmap) -> Int[Array, "N K"]:
    """For each slot, the flat index (node * K + slot) of the same edge seen from its other end."""
    num, num_slots = roadmap.neighbors.shape
    back = roadmap.neighbors[roadmap.neighbors]  # [N K K]
    there = roadmap.neighbor_mask[roadmap.neighbors]
    slot = jnp.argmax((back == jnp.arange(num)[:, None, None]) & there, axis=-1)
    return roadmap.neighbors * num_slots + slot


def edge_bucket(max_edges: int) -> int:
    """The padded number of directed edges of a graph: the next multiple of 1024."""
    return -(-max_edges // 1024) * 1024


def graphs_tuple(roadmap: Roadmap, max_edges: int) -> jraph.GraphsTuple:
    """The roadmap as a jraph graph, padded the way jraph does it.

    The first graph holds the N nodes and the directed edges, in the order of the slots, each from a
    neighbour (sender) to the slot's owner (receiver). The second holds one dummy node, N, and the
    padding edges on it.

    Args:
        roadmap: one roadmap.
        max_edges: size of the edge arrays; edges beyond it would be lost, so it must be enough.
    """
    num, num_slots = roadmap.neighbors.shape
    flat = roadmap.neighbor_mask.reshape(-1)
    (slot,) = jnp.nonzero(flat, size=max_edges, fill_value=-1)
    real = slot >= 0
    receivers = jnp.where(real, slot // num_slots, num).astype(jnp.int32)
    senders = jnp.where(real, roadmap.neighbors.reshape(-1)[slot], num).astype(jnp.int32)
    lengths = jnp.where(real, roadmap.lengths.reshape(-1)[slot], 0.0)
    num_edges = real.sum()
    return jraph.GraphsTuple(
        nodes=jnp.concatenate([roadmap.nodes, jnp.zeros_like(roadmap.nodes[:1])]),
        edges=lengths[:, None],
        senders=senders,
        receivers=receivers,
        globals=None,
        n_node=jnp.array([num, 1]),
        n_edge=jnp.stack([num_edges, max_edges - num_edges]),
    )
