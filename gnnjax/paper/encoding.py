"""What the guidance network knows of a query and of the path, and what it says of the edges."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Encoding(NamedTuple):
    """What the network knows of a query before the first step. Row i belongs to node i."""

    code: Float[Array, "*batch N C"]  # x, what the GRU reads
    environment: Float[Array, "*batch N C"]  # o
    key: Float[Array, "*batch N C"]  # K_e
    value: Float[Array, "*batch N C"]  # V_e
    self_score: Float[Array, "*batch N"]  # Q_e,i . K_e,i, before scaling
    decoder_near: Float[Array, "*batch N C"]  # share of node i in its decoder rows
    decoder_far: Float[Array, "*batch N C"]  # share of node j in the decoder rows that end there
    validity: Float[Array, "*batch N K"]  # logit that a slot's edge is free; symmetric
    through: Float[Array, "*batch N K"]  # likely cost of the way through a neighbor, units of pi
    goal_distance: Float[Array, "*batch N"]  # Euclidean, in units of pi


class PathState(NamedTuple):
    """The path walked so far: a GRU state, and a memory of its last L nodes."""

    hidden: Float[Array, "*batch C"]
    queries: Float[Array, "*batch L C"]  # Q_p, a ring once more than L nodes are walked
    values: Float[Array, "*batch L C"]  # V_p
    length: Int[Array, "*batch"]  # nodes walked


class EdgeOutputs(NamedTuple):
    """Outputs for every slot of a roadmap. Zero on padding; callers mask."""

    values: Float[Array, "*batch N K"]  # guidance values, larger is better
    validity: Float[Array, "*batch N K"]  # logit that the edge is collision-free; symmetric


def empty_path(max_path: int, channels: int) -> PathState:
    """The path before its first node, with room for `max_path` nodes in its memory."""
    memory = jnp.zeros((max_path, channels))
    return PathState(jnp.zeros(channels), memory, memory, jnp.zeros((), jnp.int32))


def remember(
    state: PathState,
    hidden: Float[Array, " C"],
    query: Float[Array, " C"],
    value: Float[Array, " C"],
) -> PathState:
    """Appends a node, given what the network makes of it. With a full memory, the oldest leaves."""
    slot = state.length % len(state.queries)
    return PathState(
        hidden=hidden,
        queries=state.queries.at[slot].set(query),
        values=state.values.at[slot].set(value),
        length=state.length + 1,
    )


def attend_to_path(
    state: PathState,
    key: Float[Array, " C"],
    self_score: Float[Array, ""],
    value: Float[Array, " C"],
) -> Float[Array, " C"]:
    """The softmax of `[Q_e,i K_e,i | Q_p K_e,i]` weighs `[V_e,i | V_p]`.

    Args:
        state: the path; nothing but node i itself if it is empty.
        key: of node i.
        self_score: of node i.
        value: of node i.
    """
    max_path, channels = state.queries.shape
    scores = jnp.append(state.queries @ key, self_score)
    walked = jnp.append(jnp.arange(max_path) < state.length, True)
    weights = jax.nn.softmax(scores / jnp.sqrt(channels), where=walked)
    return weights[:-1] @ state.values + weights[-1] * value


def edge_geometry(
    lengths: Float[Array, " E"],
    near: Float[Array, "*scalar_or_E"],
    far: Float[Array, " E"],
    through: Float[Array, " E"],
) -> Float[Array, "E 5"]:
    """Length, goal distances of both ends, progress per length, and the likely cost of the way.

    Distances in units of pi.
    """
    lengths = lengths / jnp.pi
    progress = (near - far) / jnp.maximum(lengths, 1e-6)
    near = jnp.broadcast_to(near, far.shape)
    # Padded slots have no length, and a padding row may pair nodes that are far apart.
    return jnp.stack([lengths, near, far, jnp.clip(progress, -1.0, 1.0), through], axis=-1)
