"""Shortening in the guide's eyes, with prices that are made up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from gnnjax.collision.edges import EdgeChecks
from gnnjax.roadmap.graph import GOAL
from gnnjax.search.lazy import lazy_search
from gnnjax.search.path_roadmap import path_roadmap, shortened, spread_evenly

NUM = 12


def free(q):
    """The square without a disc in its middle."""
    return jnp.linalg.norm(q - 0.5, axis=-1) > 0.3


def motion_free(starts, ends):
    fraction = jnp.linspace(0, 1, 40)[:, None, None]
    return free(starts + fraction * (ends - starts)).all(axis=0)


def check_edge(start, end):
    return EdgeChecks(motion_free(start[None], end[None])[0], jnp.int32(40))


@jax.jit
def shorten(points, scale):
    """`scale` is what a blocked motion costs."""
    return shortened(points, lambda starts, ends: scale * ~motion_free(starts, ends))


@jax.jit
def search(roadmap, prices):
    return lazy_search(roadmap, check_edge, None, prices)


spread = jax.jit(spread_evenly, static_argnums=2)


def zigzag(seed):
    """A free path around the disc, jagged, as nodes and their order."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(-2.3, 0.8, 9)
    reach = rng.uniform(0.45, 0.6, 9)[:, None]
    line = 0.5 + reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    nodes = np.concatenate([line[[0, -1]], line[1:-1], rng.random((3, 2))]).astype(np.float32)
    path = np.array([0, *range(2, 9), 1, -1, -1, -1], np.int32)
    return nodes, path


def length(points):
    return np.linalg.norm(np.diff(points, axis=0), axis=1).sum()


def in_order(points):
    """The points with the goal at the end."""
    points = np.asarray(points)
    return np.concatenate([points[:1], points[2:], points[1:2]])


@pytest.mark.parametrize("seed", range(3))
def test_points_are_spread_evenly_along_a_path(seed):
    nodes, path = zigzag(seed)
    found = in_order(spread(path, nodes, NUM))
    line = nodes[path[path >= 0]].astype(float)
    reached = np.concatenate([[0], np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()])
    wanted = np.linspace(0, reached[-1], NUM)
    expected = np.stack([np.interp(wanted, reached, line[:, d]) for d in range(2)], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_points_on_a_path_without_length_are_all_the_same():
    nodes, path = np.full((4, 2), 0.3, np.float32), np.array([0, 1, -1, -1], np.int32)
    np.testing.assert_array_equal(spread(path, nodes, NUM), np.full((NUM, 2), 0.3, np.float32))


def test_a_path_roadmap_joins_all_to_all():
    nodes, _ = zigzag(0)
    roadmap = path_roadmap(jnp.asarray(nodes))
    num = len(nodes)
    np.testing.assert_array_equal(roadmap.neighbor_mask, ~np.eye(num, dtype=bool))
    np.testing.assert_array_equal(roadmap.neighbors, np.tile(np.arange(num), (num, 1)))
    np.testing.assert_allclose(roadmap.lengths, cdist(nodes, nodes), atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_shortened_path_is_shorter_and_free(seed):
    nodes, path = zigzag(seed)
    points = spread(path, nodes, NUM)
    roadmap, prices = shorten(points, 10.0)
    np.testing.assert_array_equal(prices, np.asarray(prices).T)
    np.testing.assert_array_equal(np.asarray(roadmap.nodes)[:2], nodes[:2])
    found = search(roadmap, prices)
    assert found.success
    walked = np.asarray(found.path)[np.asarray(found.path) >= 0]
    assert walked[0] == 0
    assert walked[-1] == GOAL
    line = np.asarray(roadmap.nodes)[walked]
    assert np.asarray(motion_free(line[:-1], line[1:])).all()
    assert length(line) < length(nodes[path[path >= 0]])
    # With the truth for a price, no check is wasted.
    assert int(found.edge_checks) == len(walked) - 1


def test_where_nothing_costs_anything_a_path_becomes_straight():
    nodes, path = zigzag(0)
    roadmap, prices = shorten(spread(path, nodes, NUM), 0.0)
    assert (np.asarray(prices) == 0).all()
    line = in_order(roadmap.nodes)
    np.testing.assert_allclose(line, np.linspace(nodes[0], nodes[1], NUM), atol=1e-5)
    # That is blocked, and so is what lies beside it.
    found = search(roadmap, prices)
    assert not found.success
