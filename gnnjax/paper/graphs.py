"""Roadmaps as jraph graphs."""

import jax.numpy as jnp
import jraph
import numpy as np

from gnnjax.roadmap.graph import Roadmap, default_mean_degree, node_bucket


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
