"""Edges against a plain loop over MuJoCo's C engine."""

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.collision.checker import EDGE_RESOLUTION, make_checker
from gnnjax.collision.edges import bisection_order
from gnnjax.collision.edges import test_edges as cut_and_test
from gnnjax.scene.scene import box_scene, make_scene
from tests.c_engine import Engine
from tests.draws import random_boxes, random_configurations

FEW, MANY = 5, 640  # edges at a time; each number of them is compiled


@pytest.fixture(scope="module")
def tiny_checker(tiny):
    return make_checker(tiny)


@pytest.fixture(scope="module")
def tiny_edges(tiny_checker):
    return jax.jit(tiny_checker.check_edges)


def plain_check_edge(engine, robot, start, end):
    """Tests an edge point by point: `(valid, number of points tested)`."""
    start, end = (np.asarray(x, np.float32) for x in (start, end))
    if tuple(start) > tuple(end):
        start, end = end, start
    length = np.linalg.norm(end - start)
    intervals = max(1, int(np.ceil(length / np.float32(EDGE_RESOLUTION))))
    num_checks = 0
    stretches = deque([(0, intervals)])
    while stretches:
        low, high = stretches.popleft()
        middle = (low + high) // 2
        if middle == low:
            continue
        stretches += [(low, middle), (middle, high)]
        num_checks += 1
        q = start + np.float32(middle) / np.float32(intervals) * (end - start)
        if engine.gap(q) <= 0:
            return False, num_checks
    return True, num_checks


def test_edges_match_plain_loop(tiny, tiny_edges):
    rng = np.random.default_rng(5)
    scene = random_boxes(rng, 2, rotated=True)
    engine = Engine(tiny)
    engine.place(scene)
    starts, ends = (random_configurations(rng, tiny, 200) for _ in range(2))
    # Long and short edges.
    ends = starts + (ends - starts) * np.linspace(0.02, 1, 200, dtype=np.float32)[:, None]
    expected = [plain_check_edge(engine, tiny, s, e) for s, e in zip(starts, ends, strict=True)]
    valid, num_checks = (np.array(column) for column in zip(*expected, strict=True))
    assert 20 < valid.sum() < 180
    for there, back in ((starts, ends), (ends, starts)):
        checks = tiny_edges(scene, *(np.resize(x, (MANY, 3)) for x in (there, back)))
        np.testing.assert_array_equal(checks.valid, np.resize(valid, MANY))
        np.testing.assert_array_equal(checks.num_checks, np.resize(num_checks, MANY))
    # Few edges are tested in other blocks than many.
    few = tiny_edges(scene, starts[-FEW:], ends[-FEW:])
    np.testing.assert_array_equal(few.valid, valid[-FEW:])
    np.testing.assert_array_equal(few.num_checks, num_checks[-FEW:])


def test_many_edges_come_to_what_few_come_to(tiny, tiny_checker, tiny_edges):
    """More than wait in the queue at a time, of all lengths, some of which cannot be tested."""
    rng = np.random.default_rng(8)
    scenes = [random_boxes(rng, num, rotated=True) for num in (0, 2)]
    starts, ends = np.array([random_configurations(rng, tiny, MANY) for _ in range(2)])
    ends = starts + (ends - starts) * rng.random((MANY, 1), np.float32) ** 2
    ends[::50] = starts[::50]
    ends[7::100, 1], ends[9::100, 0] = np.nan, 100.0
    at_once = jax.jit(jax.vmap(tiny_checker.check_edges, in_axes=(0, None, None)))(
        jax.tree.map(lambda *x: np.stack(x), *scenes), starts, ends
    )
    for number, scene in enumerate(scenes):
        parts = [
            tiny_edges(scene, starts[first : first + 64], ends[first : first + 64])
            for first in range(0, MANY, 64)
        ]
        few = jax.tree.map(lambda *x: np.concatenate(x), *parts)
        many = tiny_edges(scene, starts, ends)
        for found in (many, jax.tree.map(lambda x, i=number: x[i], at_once)):
            np.testing.assert_array_equal(found.valid, few.valid)
            np.testing.assert_array_equal(found.num_checks, few.num_checks)
        assert MANY // 4 < few.valid.sum() < MANY - MANY // 50
        assert not few.valid[7::100].any()
        assert not few.valid[9::100].any()


def test_edges_leave_no_gap_wider_than_the_resolution():
    # An obstacle a bit wider than the resolution, anywhere on the edge, must be found, and a free
    # edge must take no more tests than that needs.
    order = bisection_order(80)

    def check(scene, q):
        return jnp.abs(q[:, 0] - scene.centers[0, 0]) > EDGE_RESOLUTION / 2 + 1e-5

    def edge(target, length):
        scene = box_scene(
            jnp.full((1, 3), target), jnp.ones((1, 3)), jnp.ones((1, 4)), jnp.ones(1, bool)
        )
        start, end = jnp.zeros((1, 1)), jnp.full((1, 1), length)
        return cut_and_test(check, order, EDGE_RESOLUTION, scene, start, end)

    lengths = np.random.default_rng(6).uniform(0.06, 3.9, 40).astype(np.float32)
    lengths = np.repeat(lengths, 50)
    inside = np.tile(np.linspace(0, 1, 50, dtype=np.float32), 40)
    targets = EDGE_RESOLUTION / 2 + inside * (lengths - EDGE_RESOLUTION)
    checks = jax.jit(jax.vmap(edge))(targets.astype(np.float32), lengths)
    assert not checks.valid.any()
    free = jax.jit(jax.vmap(edge))(np.full_like(lengths, 100), lengths)
    assert free.valid.all()
    np.testing.assert_array_equal(
        free.num_checks[:, 0], np.ceil(lengths / np.float32(EDGE_RESOLUTION)) - 1
    )


def test_edges_of_no_length_are_valid_and_those_beyond_range_are_not(tiny, tiny_edges):
    scene = jax.tree.map(jnp.asarray, make_scene([], []))
    q, bad = np.zeros((2, FEW, 3), np.float32)
    bad[::2, 1], bad[1::2, 0] = np.nan, 100.0
    checks = tiny_edges(scene, q, q)
    assert checks.valid.all()
    assert not checks.num_checks.any()
    checks = tiny_edges(scene, q, bad)
    assert not checks.valid.any()


def test_edges_are_tested_alike_eagerly_compiled_and_mapped(tiny, tiny_checker, tiny_edges):
    rng = np.random.default_rng(7)
    scenes = [random_boxes(rng, num, rotated=True, reach=0.7) for num in (0, 4, 8)]
    starts, ends = (random_configurations(rng, tiny, FEW) for _ in range(2))
    eager = tiny_checker.check_edges(scenes[1], jnp.asarray(starts), jnp.asarray(ends))
    jitted = [tiny_edges(scene, starts, ends) for scene in scenes]
    stacked = jax.tree.map(lambda *x: np.stack(x), *scenes)
    mapped = jax.jit(jax.vmap(tiny_checker.check_edges, in_axes=(0, None, None)))(
        stacked, starts, ends
    )
    for field in range(2):
        np.testing.assert_array_equal(eager[field], jitted[1][field])
        for s in range(3):
            np.testing.assert_array_equal(mapped[field][s], jitted[s][field])
    assert 0 < mapped.valid.sum() < mapped.valid.size


def test_the_order_of_tests_halves_what_is_left():
    order = bisection_order(70)
    assert order.shape == (71, 70)
    for n, row in enumerate(order):
        inner = max(n - 1, 0)
        assert sorted(row[:inner]) == list(range(1, n))
        assert not row[inner:].any()
    assert order[8, :7].tolist() == [4, 2, 6, 1, 3, 5, 7]
    # After 2^k - 1 tests no stretch longer than n / 2^k, rounded up, is left.
    for n in (17, 40, 64):
        for k in range(1, 5):
            tested = np.sort(np.concatenate([[0, n], order[n, : 2**k - 1]]))
            assert np.diff(tested).max() <= -(-n // 2**k)
