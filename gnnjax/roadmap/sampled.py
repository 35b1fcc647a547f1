"""Roadmaps of free configurations, drawn uniformly by rejection."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.robot import Robot
from gnnjax.roadmap.graph import Roadmap, connect, default_slots, node_bucket


class Samples(NamedTuple):
    """Free configurations and what drawing them cost."""

    nodes: Float[Array, "*batch N D"]  # rad or m; only where `mask`
    mask: Bool[Array, "*batch N"]  # false where the draws ran out
    num_checks: Int[Array, "*batch"]  # configurations tested until the last one was found


def sample_free(
    key: jax.Array,
    check_configurations: Callable[[jax.Array], jax.Array],
    lower: np.ndarray | jax.Array,
    upper: np.ndarray | jax.Array,
    num: int,
    *,
    wanted: int | Int[Array, ""] | None = None,
    max_blocks: int = 50,
) -> Samples:
    """Draws configurations uniformly between the joint limits and keeps the valid ones.

    Args:
        key: randomness.
        check_configurations: `[B D] -> [B]`, true where valid.
        lower: `[D]` lower joint limits.
        upper: `[D]` upper joint limits.
        num: N, the size of the result.
        wanted: stop after that many; by default N.
        max_blocks: give up after that many blocks of N draws.
    """
    wanted = jnp.asarray(num if wanted is None else wanted, jnp.int32)
    num_dof = len(lower)

    def unfinished(state):
        count, blocks, *_ = state
        return (count < wanted) & (blocks < max_blocks)

    def draw_block(state):
        count, blocks, num_checks, nodes = state
        block_key = jax.random.fold_in(key, blocks)
        q = jax.random.uniform(block_key, (num, num_dof), minval=lower, maxval=upper)
        valid = check_configurations(q)
        rank = count + jnp.cumsum(valid) - 1
        used = valid & (rank < wanted)
        nodes = nodes.at[jnp.where(used, rank, num)].set(q, mode="drop")
        # A sequential sampler stops at the last configuration it needs.
        is_last = used & (rank == wanted - 1)
        tested = jnp.where(jnp.any(is_last), jnp.argmax(is_last) + 1, num)
        return count + used.sum(), blocks + 1, num_checks + tested, nodes

    zero = jnp.int32(0)
    nodes = jnp.zeros((num, num_dof), jnp.float32)
    count, _, num_checks, nodes = jax.lax.while_loop(
        unfinished, draw_block, (zero, zero, zero, nodes)
    )
    return Samples(nodes, jnp.arange(num) < count, num_checks)


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
        # An end may lie in another turn of a joint.
        jnp.minimum(robot.drawn_lower, jnp.minimum(start, goal)),
        jnp.maximum(robot.drawn_upper, jnp.maximum(start, goal)),
        padded - 2,
        wanted=num_nodes - 2,
    )
    nodes = jnp.concatenate([jnp.stack([start, goal]), samples.nodes])
    mask = jnp.concatenate([jnp.ones(2, bool), samples.mask])
    return SampledRoadmap(connect(nodes, mask, radius, default_slots(padded)), samples.num_checks)
