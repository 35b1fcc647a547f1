"""Roadmaps whose nodes nobody has checked: drawn once an arm, and joined with each query's ends.

The nodes come from a low-discrepancy sequence and are free of self-collision; which of them the
obstacles block is found out by the search, for those few that it wants to use (lazy PRM, Bohlin and
Kavraki 2000; roadmaps kept for any scene, Leven and Hutchinson 2002). Where a first roadmap does
not do, the next ones also have nodes around start and goal, since most problems are tight there.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import self_clearance
from gnnjax.errors import InputError
from gnnjax.roadmap.graph import Roadmap, connect, connect_where, default_radius, node_bucket
from gnnjax.roadmap.sobol import sobol_points

_SLOTS = 32
_END_REACH = 1.3  # of the radius: how far start and goal are joined with nodes
NUM_LOCAL = 64  # nodes around either end
_LOCAL_SCALES = (0.15, 0.3, 0.6, 1.0)  # rad (or m), standard deviations around an end
_CANDIDATES = 6  # drawn for each local node; the network picks
_LOCAL_SLOTS = 112
_NEAR_NODES, _NEAR_LOCAL = 20, 8  # neighbors of a local node of either kind


@functools.lru_cache(maxsize=64)
def stored_roadmap(robot: Robot, num_nodes: int, seed: int) -> Roadmap:
    """The nodes of a scrambled Sobol sequence that are free of self-collision, joined within the
    default radius; no start, no goal.

    Args:
        robot: the arm.
        num_nodes: N, padded so that N + 2 is `node_bucket(N + 2)`.
        seed: of the scrambling.

    Raises:
        InputError: hardly any configuration of the arm is free of self-collision.
    """
    nodes = np.zeros((0, robot.num_dof), np.float32)
    block = 1 << int(num_nodes - 1).bit_length()
    for number in range(20):
        drawn = sobol_points(robot.num_dof, seed, number * block, block)
        drawn = (robot.joint_lower + drawn * robot.joint_range).astype(np.float32)
        drawn = np.clip(drawn, robot.joint_lower, robot.joint_upper)
        nodes = np.concatenate([nodes, drawn[self_clearance(robot, drawn) > 0]])[:num_nodes]
        if len(nodes) == num_nodes:
            padding = node_bucket(num_nodes + 2) - 2 - num_nodes
            mask = np.arange(num_nodes + padding) < num_nodes
            nodes = np.pad(nodes, ((0, padding), (0, 0)))
            return _connect(nodes, mask, default_radius(robot, num_nodes + 2), _SLOTS)
    raise InputError(
        f"{robot.name} is in self-collision at nearly every configuration; check the geoms that "
        "collide and the pairs that its MJCF excludes"
    )


_connect = jax.jit(connect, static_argnames="num_slots")


def insert_ends(
    stored: Roadmap, start: Float[Array, " D"], goal: Float[Array, " D"], radius: float
) -> Roadmap:
    """A stored roadmap with start and goal as nodes 0 and 1.

    Both are joined with the nearest nodes, farther than nodes are with each other, and with each
    other whatever their distance.

    Args:
        stored: N nodes with K slots; the result has N + 2 with K + 2.
        start: configuration.
        goal: configuration.
        radius: of the stored roadmap, configuration units.
    """
    num, num_slots = stored.neighbors.shape
    ends = jnp.stack([start, goal])
    far = jnp.linalg.norm(stored.nodes - ends[:, None], axis=-1)  # [2 N]
    far = jnp.where(stored.node_mask, far, jnp.inf)
    negative, near = jax.lax.top_k(-far, num_slots + 1)
    joined = -negative <= _END_REACH * radius
    member = jnp.zeros((2, num), bool).at[jnp.arange(2)[:, None], near].set(joined).T  # [N 2]
    own = jnp.arange(num + 2)[:, None]
    end_neighbors = jnp.concatenate([own[1::-1], jnp.where(joined, near + 2, own[:2])], axis=1)
    end_lengths = jnp.where(joined, -negative, 0.0)
    direct = jnp.full((2, 1), jnp.linalg.norm(goal - start))
    node_slots = jnp.concatenate([stored.neighbor_mask, member], axis=1)
    to_ends = jnp.where(member, jnp.arange(2), own[2:])
    lengths = jnp.concatenate([stored.lengths, jnp.where(member, far.T, 0.0)], axis=1)
    return Roadmap(
        nodes=jnp.concatenate([ends, stored.nodes]),
        node_mask=jnp.concatenate([jnp.ones(2, bool), stored.node_mask]),
        neighbors=jnp.concatenate(
            [end_neighbors, jnp.concatenate([stored.neighbors + 2, to_ends], axis=1)]
        ).astype(jnp.int32),
        neighbor_mask=jnp.concatenate(
            [jnp.concatenate([jnp.ones((2, 1), bool), joined], axis=1), node_slots]
        ),
        lengths=jnp.concatenate([jnp.concatenate([direct, end_lengths], axis=1), lengths]),
        num_dropped=stored.num_dropped,
    )


def add_local_nodes(
    key: jax.Array,
    stored: Roadmap,
    start: Float[Array, " D"],
    goal: Float[Array, " D"],
    radius: float,
    limits: tuple[np.ndarray, np.ndarray],
    price: Callable[[jax.Array], jax.Array],
) -> Roadmap:
    """`insert_ends`, with `NUM_LOCAL` nodes more around either end.

    Args:
        key: randomness.
        stored: N nodes; the result has N + 2 + 2 `NUM_LOCAL`.
        start: configuration.
        goal: configuration.
        radius: of the stored roadmap, configuration units.
        limits: `[D]` lower and upper joint limits.
        price: `[B D] -> [B]`; those that it finds likely free, nodes are chosen from.
    """
    keys = jax.random.split(key, 3)
    num_drawn = _CANDIDATES * NUM_LOCAL
    ends = jnp.stack([start, goal])
    scale = jax.random.choice(keys[0], jnp.array(_LOCAL_SCALES), (2, num_drawn, 1))
    drawn = ends[:, None] + scale * jax.random.normal(keys[1], (2, num_drawn, len(start)))
    drawn = jnp.clip(drawn, *(jnp.asarray(limit) for limit in limits))
    prices = price(drawn.reshape(-1, len(start))).reshape(2, num_drawn)
    # The likely ones in a random order, then the others.
    unlikely = prices > jnp.log(2.0)
    rank = jnp.where(unlikely, 1.0 + prices, jax.random.uniform(keys[2], prices.shape))
    chosen = jnp.argsort(rank, axis=1)[:, :NUM_LOCAL, None]
    local = jnp.take_along_axis(drawn, chosen, axis=1).reshape(-1, len(start))
    nodes = jnp.concatenate([ends, local, stored.nodes])
    num = len(nodes)
    # Which end a node is or belongs to; 2 and beyond: neither.
    side = jnp.concatenate([jnp.arange(2), jnp.repeat(jnp.arange(2), NUM_LOCAL)])
    side = jnp.pad(side, (0, num - len(side)), constant_values=2)
    is_end = jnp.arange(num) < 2
    is_local = (side < 2) & ~is_end
    apart = ~jnp.eye(num, dtype=bool)
    mask = jnp.concatenate([jnp.ones(num - len(stored.nodes), bool), stored.node_mask])
    # Draws beyond a corner of the limits all end there. One of them is enough: edges without length
    # would lead a search in circles.
    equal = jnp.all(nodes[:, None] == nodes, axis=-1)
    mask &= ~jnp.any(jnp.tril(equal, -1), axis=1) | is_end

    def join(squared: Float[Array, "N N"]) -> Bool[Array, "N N"]:
        def nearest(allowed: jax.Array, count: int) -> jax.Array:
            negative = jax.lax.top_k(jnp.where(allowed, -squared, -jnp.inf), count)[0]
            return allowed & (-squared >= negative[:, -1:])

        stored_node = side == 2
        same_side = (side[:, None] == side) & ~stored_node & apart
        joined = stored_node[:, None] & stored_node & (squared <= radius**2) & apart
        joined |= nearest(~stored_node[:, None] & stored_node & mask, _NEAR_NODES)
        joined |= nearest(same_side & is_local[:, None] & is_local & mask, _NEAR_LOCAL)
        joined |= same_side & is_end[:, None]
        joined |= is_end[:, None] & is_end & apart
        return joined | joined.T

    return connect_where(nodes, mask, join, _LOCAL_SLOTS)
