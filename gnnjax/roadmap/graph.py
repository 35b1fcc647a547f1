"""Roadmaps: r-disc random geometric graphs with K slots a node."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jraph
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.robot import Robot
from gnnjax.roadmap.sampling import sample_free

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
    """Connects the pairs of nodes that a rule names.

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
    within = node_mask[:, None] & node_mask[None, :] & joined(squared)
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


class SampledRoadmap(NamedTuple):
    """A roadmap and what sampling its nodes cost."""

    roadmap: Roadmap
    num_checks: Int[Array, "*batch"]  # configurations tested, start and goal apart


def sample_roadmap(
    key: jax.Array,
    check_configurations: Callable[[jax.Array], jax.Array],
    robot: Robot,
    start: Float[Array, " D"],
    goal: Float[Array, " D"],
    *,
    num_nodes: int,
    radius: float,
) -> SampledRoadmap:
    """Samples free configurations uniformly and connects them with the start and the goal.

    Args:
        key: randomness.
        check_configurations: `[B D] -> [B]`, true where valid.
        robot: the arm, for its joint limits.
        start: node 0.
        goal: node 1.
        num_nodes: nodes, start and goal included; arrays are padded to `node_bucket(num_nodes)`.
        radius: largest length of an edge, configuration units.
    """
    padded = node_bucket(num_nodes)
    samples = sample_free(
        key,
        check_configurations,
        robot.joint_lower,
        robot.joint_upper,
        padded - 2,
        wanted=num_nodes - 2,
    )
    nodes = jnp.concatenate([jnp.stack([start, goal]), samples.nodes])
    mask = jnp.concatenate([jnp.ones(2, bool), samples.mask])
    return SampledRoadmap(connect(nodes, mask, radius, default_slots(padded)), samples.num_checks)


def reverse_slots(roadmap: Roadmap) -> Int[Array, "N K"]:
    """For each slot, the flat index (node * K + slot) of the same edge seen from its other end."""
    num, num_slots = roadmap.neighbors.shape
    own = jnp.broadcast_to(jnp.arange(num)[:, None], roadmap.neighbors.shape)
    # Padding slots lead to their own node and would overwrite the entry of none but that.
    slot = jnp.broadcast_to(jnp.arange(num_slots), roadmap.neighbors.shape)
    table = jnp.zeros((num, num), jnp.int32).at[own, roadmap.neighbors].set(slot)
    return roadmap.neighbors * num_slots + table[roadmap.neighbors, own]


def edge_bucket(num_nodes: int) -> int:
    """The padded number of directed edges of a roadmap with the default mean degree.

    Half as many again as expected, then up to a multiple of 1024.
    """
    padded = node_bucket(num_nodes)
    return 1024 * int(np.ceil(1.5 * padded * default_mean_degree(padded) / 1024))


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
