"""What the guidance network knows of a query and of the path, and what it says of the edges."""

from typing import NamedTuple

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
