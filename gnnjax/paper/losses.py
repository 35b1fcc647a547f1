"""What the guidance network learns: the way to the goal, and which edges are valid."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from gnnjax.paper.encoding import Encoding
from gnnjax.paper.graphs import edge_bucket
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.problems.labelled import LabelledRoadmap
from gnnjax.roadmap.graph import GOAL, START
from gnnjax.scene.scene import Scene


def step_targets(
    data: LabelledRoadmap, temperature: float
) -> tuple[Float[Array, "N K"], Float[Array, " N"]]:
    """What the guidance values of each node should be, as probabilities, and which nodes count.

    The best neighbor is the next node of the shortest path (Dijkstra's label). With a temperature,
    neighbors count by how much longer the way through them is, `softmax(-detour / temperature)`.
    """
    roadmap, labels = data.roadmap, data.labels
    usable = roadmap.neighbor_mask & labels.edge_valid
    through = jnp.where(usable, roadmap.lengths + labels.cost_to_go[roadmap.neighbors], jnp.inf)
    counts = jnp.isfinite(labels.cost_to_go) & roadmap.node_mask
    counts = counts & (jnp.arange(len(counts)) != GOAL)
    if temperature == 0:
        best = roadmap.neighbors == labels.next_node[:, None]
        target = (best & usable).astype(jnp.float32)
    else:
        detour = through - jnp.where(counts, labels.cost_to_go, 0.0)[:, None]
        logits = jnp.where(jnp.isfinite(detour), -detour / temperature, -1e9)
        target = jnp.where(jnp.isfinite(detour), jax.nn.softmax(logits), 0.0)
    return target, counts.astype(jnp.float32)


def cross_entropy(
    values: Float[Array, "*rows K"], target: Float[Array, "*rows K"], mask: Bool[Array, "*rows K"]
) -> Float[Array, "*rows"]:
    """Cross-entropy of the guidance values' softmax over existing neighbors."""
    logits = jnp.where(mask, values, -1e9)
    return -jnp.sum(target * jax.nn.log_softmax(logits), axis=-1)


def walk_losses(
    network: GuidanceNetwork,
    encoding: Encoding,
    data: LabelledRoadmap,
    target: Float[Array, "N K"],
    counts: Float[Array, " N"],
    num_steps: Int[Array, ""],
    max_walk: int,
    every_step: bool,
) -> tuple[jax.Array, jax.Array]:
    """Walks with the network; returns the summed loss of the nodes learned from, and their number.

    The walk does as Algorithm 1: from the best neighbor down, to the first whose edge is valid.
    Where it ends at the goal or a dead end, its last node stands for the rest.
    """
    roadmap, labels = data.roadmap, data.labels
    state = network.extend_path(encoding, network.init_path(), START)
    visited = jnp.arange(len(roadmap.nodes)) == START

    def step(carry, index):
        node, visited, state, walking = carry
        values = network.guidance_values(encoding, state, roadmap, node)
        loss = cross_entropy(values, target[node], roadmap.neighbor_mask[node])
        open_ = labels.edge_valid[node] & ~visited[roadmap.neighbors[node]]
        slot = jnp.argmax(jnp.where(open_, values, -jnp.inf))
        following = roadmap.neighbors[node, slot]
        last = (following == GOAL) | ~jnp.any(open_) | (index + 1 >= num_steps)
        learn = walking & (every_step | last)
        moved = network.extend_path(encoding, state, following)
        carry = (
            jnp.where(last, node, following),
            visited.at[following].set(True),
            jax.tree.map(lambda new, old: jnp.where(last, old, new), moved, state),
            walking & ~last,
        )
        weight = learn * counts[node]
        return carry, (weight * loss, weight)

    carry = (jnp.int32(START), visited, state, jnp.bool_(True))
    _, (losses, weights) = jax.lax.scan(step, carry, jnp.arange(max_walk))
    return losses.sum(), weights.sum()


def graph_losses(
    network: GuidanceNetwork,
    data: LabelledRoadmap,
    key: jax.Array,
    point_distances: Callable[[Scene, jax.Array], jax.Array] | None = None,
    *,
    max_walk: int,
    every_step: bool,
    all_nodes: bool,
    temperature: float,
    validity_weight: float,
) -> dict[str, jax.Array]:
    """The losses of one labelled roadmap, and how well it is read; `TrainConfig` has the options.

    Returns:
        `loss`, the sum that training minimizes, and its parts.
    """
    roadmap = data.roadmap
    max_edges = edge_bucket(len(roadmap.nodes))
    encoding = network.encode(roadmap, data.problem.scene, max_edges, point_distances)
    target, counts = step_targets(data, temperature)
    num_steps = jax.random.randint(key, (), 1, max_walk + 1)
    walked, number = walk_losses(
        network, encoding, data, target, counts, num_steps, max_walk, every_step
    )
    losses = {"walk_loss": walked / jnp.maximum(number, 1)}
    losses["loss"] = losses["walk_loss"]
    if not (all_nodes or validity_weight):
        return losses
    outputs = network.edge_outputs(encoding, roadmap, max_edges)
    if all_nodes:
        entropies = cross_entropy(outputs.values, target, roadmap.neighbor_mask)
        total = jnp.maximum(counts.sum(), 1)
        losses["node_loss"] = jnp.sum(entropies * counts) / total
        best = jnp.argmax(jnp.where(roadmap.neighbor_mask, outputs.values, -jnp.inf), axis=-1)
        hit = best == jnp.argmax(target, axis=-1)
        losses["node_accuracy"] = jnp.sum(hit * counts) / total
        losses["loss"] += losses["node_loss"]
    if validity_weight:
        valid = data.labels.edge_valid
        entropies = optax.sigmoid_binary_cross_entropy(outputs.validity, valid)
        losses["validity_loss"] = entropies.mean(where=roadmap.neighbor_mask)
        right = (outputs.validity > 0) == valid
        losses["validity_accuracy"] = right.mean(where=roadmap.neighbor_mask)
        losses["loss"] += validity_weight * losses["validity_loss"]
    return losses
