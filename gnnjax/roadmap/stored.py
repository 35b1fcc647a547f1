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
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import rests
from gnnjax.collision.clearances import is_self_free
from gnnjax.errors import InputError
from gnnjax.kept import keep
from gnnjax.roadmap.graph import (
    GOAL,
    SHORTEST,
    START,
    Roadmap,
    connect,
    default_radius,
    node_bucket,
)
from gnnjax.roadmap.smallest import smallest
from gnnjax.roadmap.sobol import sobol_points

_SLOTS = 32
_END_REACH = 1.3  # of the radius: how far start and goal are joined with nodes
NUM_LOCAL = 24  # nodes around either end
_LOCAL_SCALES = (0.3, 0.6, 1.0, 1.5)  # rad (or m), standard deviations around an end
_CANDIDATES = 6  # drawn for each local node; the network picks
# How many a local node is joined with: stored nodes, and those of its side; an end with stored
# nodes; and a stored node with local ones of a side.
_NEAR_NODES, _NEAR_LOCAL, _NEAR_ENDS, _NEAR_STORED = 20, 8, 20, 8


@functools.lru_cache(maxsize=64)
def stored_roadmap(robot: Robot, num_nodes: int, seed: int) -> Roadmap:
    """The nodes of a scrambled Sobol sequence where the arm is free of self-collision and may rest,
    joined within the default radius; no start, no goal.

    Args:
        robot: the arm.
        num_nodes: N, padded so that N + 2 is `node_bucket(N + 2)`.
        seed: of the scrambling.

    Raises:
        InputError: hardly any configuration of the arm is.
    """
    nodes = np.zeros((0, robot.num_dof), np.float32)
    lower, upper = robot.drawn_lower, robot.drawn_upper
    block = 1 << int(num_nodes - 1).bit_length()
    for number in range(20):
        drawn = sobol_points(robot.num_dof, seed, number * block, block)
        drawn = (lower + drawn * (upper - lower)).astype(np.float32)
        drawn = np.clip(drawn, lower, upper)
        good = is_self_free(robot, drawn) & rests(robot, drawn)
        nodes = np.concatenate([nodes, drawn[good]])[:num_nodes]
        if len(nodes) == num_nodes:
            padding = node_bucket(num_nodes + 2) - 2 - num_nodes
            mask = np.arange(num_nodes + padding) < num_nodes
            nodes = np.pad(nodes, ((0, padding), (0, 0)))
            return _connect(nodes, mask, np.float32(default_radius(robot, num_nodes + 2)))
    if robot.rest_limit is not None:
        raise InputError(
            f"{robot.name} touches itself or cannot rest within its share of torques at nearly "
            "every configuration; carry less, or allow a larger share"
        )
    raise InputError(
        f"{robot.name} is in self-collision at nearly every configuration; check the geoms that "
        "collide, and allow=[(body, body)] those that may touch"
    )


_connect = keep(functools.partial(connect, num_slots=_SLOTS))


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
    joined = (-negative <= _END_REACH * radius) & (-negative > SHORTEST)
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
    offsets: Float[Array, "2 C D"],
    stored: Roadmap,
    start: Float[Array, " D"],
    goal: Float[Array, " D"],
    radius: float,
    limits: tuple[np.ndarray, np.ndarray],
    price: Callable[[jax.Array], jax.Array],
) -> Roadmap:
    """`insert_ends`, with `NUM_LOCAL` nodes more around either end.

    A local node is joined with its end, with near ones of its side and with near stored nodes, each
    of which takes the nearest few. All of it is found from tables of local against other nodes;
    one of all nodes against all would take ten times as long.

    Args:
        offsets: of candidates for local nodes, from `local_offsets`.
        stored: N nodes with K slots; the result has 2 + 2 `NUM_LOCAL` + N, the stored nodes with
            their slots last.
        start: configuration.
        goal: configuration.
        radius: of the stored roadmap, configuration units.
        limits: `[D]` lower and upper joint limits.
        price: `[B D] -> [B]`; those that it finds likely free, nodes are chosen from.
    """
    num_local, (num_stored, num_slots) = NUM_LOCAL, stored.neighbors.shape
    ends = jnp.stack([start, goal])
    local = _choose_local(offsets, ends, limits, price)  # [2 L D]
    is_new = _differs_from_earlier(ends, local)  # [2 L]
    first_stored = 2 + 2 * num_local
    special = jnp.concatenate([ends, local.reshape(-1, ends.shape[1])])  # ends and local nodes
    special_mask = jnp.concatenate([jnp.ones(2, bool), is_new.ravel()])
    far = jnp.linalg.norm(special[:, None] - stored.nodes, axis=-1)  # [2 + 2 L, N]
    far = jnp.where(special_mask[:, None] & stored.node_mask, far, jnp.inf)
    is_end = jnp.arange(len(special)) < 2
    joined = _nearest(far, jnp.where(is_end, _NEAR_ENDS, _NEAR_NODES))
    joined &= ((far <= _END_REACH * radius) | ~is_end[:, None]) & (far > SHORTEST)
    # Of the local nodes that want it, a stored node takes the nearest of either side.
    sides = [slice(2 + side * num_local, 2 + (side + 1) * num_local) for side in (0, 1)]
    to_stored, to_special = jnp.where(joined, far, jnp.inf), []
    for side in sides:
        nearest, taken = smallest(to_stored[side].T, _NEAR_STORED)  # [N R]
        kept = jnp.full((num_stored, num_local), jnp.inf)
        kept = kept.at[jnp.arange(num_stored)[:, None], taken].set(nearest)
        to_stored = to_stored.at[side].set(kept.T)
        to_special.append((taken + side.start, nearest))
    within = jnp.linalg.norm(local[:, :, None] - local[:, None], axis=-1)  # [2 L L]
    within = jnp.where(
        is_new[:, :, None] & is_new[:, None] & ~jnp.eye(num_local, dtype=bool), within, jnp.inf
    )
    mutual = jnp.stack([_nearest(one, jnp.full(num_local, _NEAR_LOCAL)) for one in within])
    within = jnp.where(mutual & jnp.swapaxes(mutual, 1, 2), within, jnp.inf)
    to_end = jnp.where(is_new, jnp.linalg.norm(local - ends[:, None], axis=-1), jnp.inf)  # [2 L]
    # Lengths of all edges of special nodes, inf where there is none.
    table = jnp.full((len(special), first_stored), jnp.inf)
    table = table.at[START, GOAL].set(jnp.linalg.norm(goal - start))
    for end, side in enumerate(sides):
        table = table.at[end, side].set(to_end[end]).at[side, side].set(within[end])
    table = jnp.minimum(table, table.T)
    table = jnp.concatenate([table, to_stored], axis=1)  # [2 + 2 L, 2 + 2 L + N]
    width = num_slots + 2 + 2 * _NEAR_STORED
    negative, near = jax.lax.top_k(-table, width)
    rows = [(jnp.broadcast_to(jnp.arange(2), (num_stored, 2)), to_stored[:2].T), *to_special]
    stored_near = [stored.neighbors + first_stored, *(near for near, _ in rows)]
    stored_lengths = [
        jnp.where(stored.neighbor_mask, stored.lengths, jnp.inf),
        *(length for _, length in rows),
    ]
    lengths = jnp.concatenate([-negative, jnp.concatenate(stored_lengths, axis=1)])
    neighbors = jnp.concatenate([near, jnp.concatenate(stored_near, axis=1)])
    mask = jnp.isfinite(lengths)
    own = jnp.arange(len(neighbors))[:, None]
    return Roadmap(
        nodes=jnp.concatenate([special, stored.nodes]),
        node_mask=jnp.concatenate([special_mask, stored.node_mask]),
        neighbors=jnp.where(mask, neighbors, own).astype(jnp.int32),
        neighbor_mask=mask,
        lengths=jnp.where(mask, lengths, 0.0),
        num_dropped=stored.num_dropped,
    )


def local_offsets(key: jax.Array, num_dof: int) -> Float[Array, "2 C D"]:
    """Offsets from both ends of the configurations that local nodes are chosen from.

    Drawn apart, since a product that a compiler may merge with the sum would make nodes depend on
    what else is compiled.
    """
    keys = jax.random.split(key)
    num_drawn = _CANDIDATES * NUM_LOCAL
    scale = jax.random.choice(keys[0], jnp.array(_LOCAL_SCALES), (2, num_drawn, 1))
    return scale * jax.random.normal(keys[1], (2, num_drawn, num_dof))


@functools.cache
def compiled_offsets(num_dof: int) -> Callable[[np.uint32, np.uint32], jax.Array]:
    """Makes the function `(seed, number of the roadmap) -> [2 C D]` of `local_offsets`."""

    def offsets(seed: jax.Array, number: jax.Array) -> jax.Array:
        return local_offsets(jax.random.fold_in(jax.random.key(seed), number), num_dof)

    return keep(offsets)


def _choose_local(
    offsets: Float[Array, "2 C D"],
    ends: Float[Array, "2 D"],
    limits: tuple[np.ndarray, np.ndarray],
    price: Callable[[jax.Array], jax.Array],
) -> Float[Array, "2 L D"]:
    """Configurations around both ends: the first that are likely free, then the likeliest."""
    drawn = jnp.clip(ends[:, None] + offsets, *(jnp.asarray(limit) for limit in limits))
    prices = price(drawn.reshape(-1, ends.shape[1])).reshape(drawn.shape[:2])
    # Or the compiler merges the prices with what is made of them, and takes twelve times as long.
    prices = jax.lax.optimization_barrier(prices)
    order = jnp.arange(drawn.shape[1]) / drawn.shape[1]
    rank = jnp.where(prices > jnp.log(2.0), 1.0 + prices, order)
    chosen = jax.lax.top_k(-rank, NUM_LOCAL)[1][..., None]
    return jnp.take_along_axis(drawn, chosen, axis=1)


def _differs_from_earlier(
    ends: Float[Array, "2 D"], local: Float[Array, "2 L D"]
) -> Bool[Array, "2 L"]:
    """False for local nodes that are where an end is or one before them.

    Draws beyond a corner of the limits all end there. One of them is enough.
    """
    nodes = jnp.concatenate([ends, local.reshape(-1, ends.shape[1])])
    equal = jnp.all(jnp.abs(nodes[:, None] - nodes) <= SHORTEST, axis=-1)
    return ~jnp.any(jnp.tril(equal, -1), axis=1)[2:].reshape(2, -1)


def _nearest(far: Float[Array, "A B"], count: Int[Array, " A"]) -> Bool[Array, "A B"]:
    """Marks the nearest `count` of each row; infinite ones never."""
    most = min(max(_NEAR_ENDS, _NEAR_NODES, _NEAR_LOCAL), far.shape[1])
    nearest, _ = smallest(far, most)
    last = jnp.take_along_axis(nearest, jnp.minimum(count, most)[:, None] - 1, axis=1)
    return (far <= last) & jnp.isfinite(far)
