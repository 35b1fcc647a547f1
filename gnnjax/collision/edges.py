"""Edges, cut into configurations that are tested one by one, until the first that is not valid."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.scene.scene import Scene

# Beyond so many edges, those in doubt share the blocks; so many at a time, with so many
# configurations each.
_FEW_EDGES = 64
_MANY_AT_A_TIME, _MANY_STRETCH = 512, 8

_MOST_INTERVALS = 20_000  # of an edge; its table of points has the square of them, 2 bytes each


class EdgeChecks(NamedTuple):
    """What testing edges found out."""

    valid: Bool[Array, "*batch"]  # every tested configuration is valid
    # Configurations a sequential test would have tested, up to and including the first that is
    # not valid. The batched test computes up to a block more.
    num_checks: Int[Array, "*batch"]


def most_intervals(robot: Robot, resolution: float) -> int:
    """Into how many intervals the longest edge of an arm is cut.

    Raises:
        InputError: too many.
    """
    most = int(np.ceil(np.linalg.norm(robot.joint_range) / resolution)) + 1
    if most > _MOST_INTERVALS:
        raise InputError(
            f"resolution is {resolution}, which cuts the longest edge of {robot.name} into "
            f"{most} pieces; at most {_MOST_INTERVALS} are supported, choose a larger one"
        )
    return most


@functools.cache
def bisection_order(max_intervals: int) -> np.ndarray:
    """The order in which the points of an edge are tested: middle first, then quarters, ...

    A collision along an edge mostly covers a stretch of it; halving finds a stretch of length s in
    about 1/s tests wherever it lies.

    Returns:
        `[max_intervals + 1, max_intervals]` array; row n lists the interior points 1..n-1 of an
        edge cut into n intervals, then zeros.
    """
    order = np.zeros((max_intervals + 1, max_intervals), np.int16)
    for n in range(2, max_intervals + 1):
        row, level = [], [(0, n)]
        while level:
            deeper = []
            for low, high in level:
                middle = (low + high) // 2
                if middle > low:
                    row.append(middle)
                    deeper += [(low, middle), (middle, high)]
            level = deeper
        order[n, : n - 1] = row
    order.flags.writeable = False
    return order


def cut_edges(
    starts: jax.Array, ends: jax.Array, resolution: float, max_intervals: int
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Both ends of each edge `[E, D]`, its intervals, and whether it can be tested."""
    # Both directions of an edge test the very same floats, so that validity cannot depend on the
    # direction: the lexicographically smaller end comes first.
    differs = starts != ends
    first = jnp.argmax(differs, axis=-1)[:, None]
    swap = jnp.take_along_axis(starts > ends, first, axis=-1)
    low, high = jnp.where(swap, ends, starts), jnp.where(swap, starts, ends)
    length = jnp.linalg.norm(high - low, axis=-1)
    intervals = jnp.clip(jnp.ceil(length / resolution), 1, max_intervals).astype(jnp.int32)
    # NaN or a length beyond the robot's range: cannot be tested at the resolution, so not valid.
    return low, high, intervals, length <= resolution * max_intervals


def test_edges(
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    order: np.ndarray,
    resolution: float,
    scene: Scene,
    starts: jax.Array,
    ends: jax.Array,
) -> EdgeChecks:
    """Tests the configurations between the ends of edges.

    Args:
        check_configurations: `(scene, [B, D]) -> [B]`.
        order: of `bisection_order`.
        resolution: largest distance of neighbouring configurations.
        scene: one scene.
        starts: `[E, D]`.
        ends: `[E, D]`.
    """
    test = _test_many if len(starts) > _FEW_EDGES else _test_few
    return test(check_configurations, order, resolution, scene, starts, ends)


def configurations_at(
    low: jax.Array, way: jax.Array, intervals: jax.Array, point: jax.Array
) -> jax.Array:
    """Of edges from `low` `[... D]` by `way` `[... D]`, cut into intervals, those at points."""
    fraction = point / intervals.astype(low.dtype)
    return low + fraction[..., None] * way


def _configurations(
    table: jax.Array, low: jax.Array, way: jax.Array, intervals: jax.Array, step: jax.Array
) -> jax.Array:
    """Of edges from `low` `[E D]` by `way` `[E D]`, those `[E B D]` that come at steps `[B]` or
    `[E B]` of the table's order."""
    intervals = intervals[:, None]
    point = table[intervals, jnp.minimum(step, table.shape[1] - 1)]
    return configurations_at(low[:, None], way[:, None], intervals, point)


def _first_blocked(
    wanted: Bool[Array, "E B"], free: Bool[Array, "E B"]
) -> tuple[Bool[Array, " E"], Int[Array, " E"]]:
    """Whether one of the wanted configurations is not free, and how many there are up to the first
    that is not."""
    hit = wanted & ~free
    refuted = jnp.any(hit, axis=-1)
    return refuted, jnp.where(refuted, jnp.argmax(hit, axis=-1) + 1, wanted.sum(axis=-1))


def _test_few(
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    order: np.ndarray,
    resolution: float,
    scene: Scene,
    starts: jax.Array,
    ends: jax.Array,
) -> EdgeChecks:
    num_edges, num_dof = starts.shape
    # Large batches stop early edge by edge; a lone edge is tested in one or two blocks.
    block = max(8, min(64, 512 // max(num_edges, 1)))
    max_intervals, table = len(order) - 1, jnp.asarray(order)
    low, high, intervals, testable = cut_edges(starts, ends, resolution, max_intervals)

    def unfinished(state):
        done, valid, _ = state
        return jnp.any(valid & (done < intervals - 1))

    def test_block(state):
        done, valid, num_checks = state
        step = done + jnp.arange(block)  # [block]
        wanted = step < (intervals - 1)[:, None]  # [E block]
        q = _configurations(table, low, high - low, intervals, step)
        free = check_configurations(scene, q.reshape(-1, num_dof)).reshape(num_edges, block)
        refuted, tested = _first_blocked(wanted, free)
        return done + block, valid & ~refuted, num_checks + jnp.where(valid, tested, 0)

    zeros = jnp.zeros(num_edges, jnp.int32)
    _, valid, num_checks = jax.lax.while_loop(
        unfinished, test_block, (jnp.int32(0), testable, zeros)
    )
    return EdgeChecks(valid, num_checks)


def _test_many(
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    order: np.ndarray,
    resolution: float,
    scene: Scene,
    starts: jax.Array,
    ends: jax.Array,
) -> EdgeChecks:
    """`_test_few` with a queue: an edge that is decided makes room for the next.

    Together, all edges would be computed until the longest is through. The longest come first, so
    that few blocks at the end have empty rows.
    """
    num_edges, num_dof = starts.shape
    nobody = jnp.int32(num_edges)  # in rows without an edge; writes nothing
    max_intervals, table = len(order) - 1, jnp.asarray(order)
    low, high, intervals, testable = cut_edges(starts, ends, resolution, max_intervals)
    to_test = jnp.where(testable, intervals - 1, 0)  # configurations
    queue = jnp.argsort(-to_test).astype(jnp.int32)
    num_queued = (to_test > 0).sum()

    def unfinished(state):
        entered, edge, *_ = state
        return (entered < num_queued) | jnp.any(edge < nobody)

    def test_block(state):
        entered, edge, done, valid, num_checks = state
        free = edge == nobody
        place = entered + jnp.cumsum(free) - 1
        following = jnp.where(place < num_queued, queue[jnp.minimum(place, nobody - 1)], nobody)
        edge, done = jnp.where(free, following, edge), jnp.where(free, 0, done)
        at = jnp.minimum(edge, nobody - 1)
        end = jnp.where(edge < nobody, to_test[at], 0)
        step = done[:, None] + jnp.arange(_MANY_STRETCH)
        wanted = step < end[:, None]
        q = _configurations(table, low[at], (high - low)[at], intervals[at], step)
        valid_here = check_configurations(scene, q.reshape(-1, num_dof)).reshape(step.shape)
        refuted, tested = _first_blocked(wanted, valid_here)
        valid = valid.at[jnp.where(refuted, edge, nobody)].set(False, mode="drop")
        num_checks = num_checks.at[edge].add(tested, mode="drop")
        done = done + _MANY_STRETCH
        entered = jnp.minimum(entered + free.sum(), num_queued)
        return entered, jnp.where(refuted | (done >= end), nobody, edge), done, valid, num_checks

    nothing = jnp.zeros(_MANY_AT_A_TIME, jnp.int32)
    zeros = jnp.zeros(num_edges, jnp.int32)
    *_, valid, num_checks = jax.lax.while_loop(
        unfinished, test_block, (jnp.int32(0), nothing + nobody, nothing, testable, zeros)
    )
    return EdgeChecks(valid, num_checks)
