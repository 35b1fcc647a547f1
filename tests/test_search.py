"""Searches: the jitted loop against the plain one, laws, and corners."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from gnnjax.collision.edges import EdgeChecks
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.paper.strategy import network_scorer
from gnnjax.problems.labelled import label_roadmap
from gnnjax.roadmap.graph import GOAL, connect
from gnnjax.roadmap.paths import edge_validity
from gnnjax.scene.scene import make_scene
from gnnjax.search.greedy import (
    distance_scorer,
    greedy_search,
    greedy_search_on_host,
    oracle_scorer,
    static_scorer,
)
from gnnjax.search.lazy import lazy_search


def check_edges(starts, ends):
    """Edges whose middle lies in a ball around the centre of the cube are blocked."""
    middle = (starts + ends) / 2
    valid = jnp.linalg.norm(middle - 0.5, axis=-1) > 0.35
    return EdgeChecks(valid, jnp.where(valid, 7, 2))


def check_edge(start, end):
    return check_edges(start, end)


@jax.jit
def make_roadmap(key):
    nodes = jax.random.uniform(key, (50, 3))
    return connect(nodes, jnp.ones(50, bool), 0.42, 20)


@jax.jit
def label(roadmap):
    return label_roadmap(roadmap, edge_validity(roadmap, check_edges).edge_valid)


@jax.jit
def by_distance(roadmap):
    return greedy_search(roadmap, distance_scorer(roadmap), check_edge)


@jax.jit
def by_oracle(roadmap, cost):
    return greedy_search(roadmap, oracle_scorer(roadmap, cost), check_edge)


lazily = jax.jit(lambda roadmap: lazy_search(roadmap, check_edge))


def path_cost(roadmap, path):
    nodes = np.asarray(roadmap.nodes)[np.asarray(path)[np.asarray(path) >= 0]]
    return np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum()


@pytest.mark.parametrize("seed", range(6))
def test_the_jitted_walk_equals_the_walk_on_the_host(seed):
    roadmap = make_roadmap(jax.random.key(seed))
    jitted = by_distance(roadmap)
    host = greedy_search_on_host(roadmap, distance_scorer(roadmap), check_edge)
    for ours, theirs in zip(jitted, host, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_network_walks_the_same_way_jitted_and_on_the_host():
    network = GuidanceNetwork(channels=8, rngs=nnx.Rngs(0))
    scene = jax.tree.map(jnp.asarray, make_scene([[0.5, 0.5, 0.5]], [[0.2, 0.2, 0.2]]))

    @jax.jit
    def encode(roadmap):
        return network.encode(roadmap, scene)

    @jax.jit
    def walk(roadmap, encoding):
        return greedy_search(roadmap, network_scorer(network, encoding, roadmap), check_edge)

    for seed in range(3):
        roadmap = make_roadmap(jax.random.key(seed))
        encoding = encode(roadmap)
        jitted = walk(roadmap, encoding)
        scorer = network_scorer(network, encoding, roadmap)
        host = greedy_search_on_host(roadmap, scorer, check_edge)
        for ours, theirs in zip(jitted, host, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_a_batch_of_walks_equals_a_loop():
    keys = jax.random.split(jax.random.key(7), 5)
    roadmaps = jax.vmap(make_roadmap)(keys)
    batch = jax.vmap(by_distance)(roadmaps)
    for i in range(5):
        single = by_distance(jax.tree.map(lambda x, i=i: x[i], roadmaps))
        jax.tree.map(
            lambda b, s, i=i: np.testing.assert_array_equal(b[i], s), tuple(batch), tuple(single)
        )


@pytest.mark.parametrize("seed", range(8))
def test_lazy_search_finds_the_shortest_path_or_that_there_is_none(seed):
    roadmap = make_roadmap(jax.random.key(seed))
    labels = label(roadmap)
    found = lazily(roadmap)
    assert bool(found.success) == bool(np.isfinite(labels.cost_to_go[0]))
    if found.success:
        np.testing.assert_allclose(path_cost(roadmap, found.path), labels.cost_to_go[0], rtol=1e-5)
        assert int(found.edge_checks) <= int(roadmap.neighbor_mask.sum()) // 2


lazily_priced = jax.jit(lambda roadmap, price: lazy_search(roadmap, check_edge, None, price))


@pytest.mark.parametrize("seed", range(8))
def test_a_priced_search_fails_only_where_there_is_no_path(seed):
    roadmap = make_roadmap(jax.random.key(seed))
    labels = label(roadmap)
    draws = np.random.default_rng(seed).exponential(size=(50, 50))
    own, neighbors = np.arange(50)[:, None], np.asarray(roadmap.neighbors)
    price = draws[np.minimum(own, neighbors), np.maximum(own, neighbors)].astype(np.float32)
    found = lazily_priced(roadmap, jnp.asarray(price))
    assert bool(found.success) == bool(np.isfinite(labels.cost_to_go[0]))
    if found.success:
        assert path_cost(roadmap, found.path) >= labels.cost_to_go[0] - 1e-5


@pytest.mark.parametrize("seed", range(4))
def test_with_the_truth_for_a_price_no_check_is_wasted(seed):
    roadmap = make_roadmap(jax.random.key(seed))
    labels = label(roadmap)
    found = lazily_priced(roadmap, jnp.where(labels.edge_valid, 0.0, 1e3))
    if found.success:
        np.testing.assert_allclose(path_cost(roadmap, found.path), labels.cost_to_go[0], rtol=1e-5)
        steps = int((np.asarray(found.path) >= 0).sum()) - 1
        assert int(found.edge_checks) == steps


@pytest.mark.parametrize("seed", range(8))
def test_the_oracle_walks_the_shortest_path_and_checks_only_its_edges(seed):
    roadmap = make_roadmap(jax.random.key(seed))
    labels = label(roadmap)
    found = by_oracle(roadmap, labels.cost_to_go)  # infinite where the goal cannot be reached
    assert bool(found.success) == bool(np.isfinite(labels.cost_to_go[0]))
    if not found.success:
        return
    # It may first try an edge that is blocked but would lead to a good node.
    steps = int((np.asarray(found.path) >= 0).sum()) - 1
    assert int(found.edge_checks) >= steps
    assert int(found.configuration_checks) >= 7 * steps


def test_known_edges_cost_nothing():
    roadmap = make_roadmap(jax.random.key(1))
    first = lazily(roadmap)
    again = lazy_search(roadmap, check_edge, first.edge_status)
    assert int(again.edge_checks) == int(again.configuration_checks) == 0
    np.testing.assert_array_equal(again.path, first.path)


@pytest.mark.parametrize("value", [-np.inf, np.nan])
def test_a_walk_ends_whatever_the_scorer_says(value):
    roadmap = make_roadmap(jax.random.key(0))
    scorer = static_scorer(lambda node: jnp.full(roadmap.neighbors.shape[1], value))
    found = greedy_search(roadmap, scorer, check_edge)
    walked = np.asarray(found.path)[np.asarray(found.path) >= 0]
    assert len(set(walked.tolist())) == len(walked)
    assert bool(found.success) == (walked[-1] == GOAL)


@pytest.fixture(scope="module")
def apart():
    """Start and goal alone, without an edge, and padding."""
    nodes = np.zeros((50, 3), np.float32)
    nodes[1] = 1.0
    return jax.jit(lambda *graph: connect(*graph, 0.42, 20))(nodes, np.arange(50) < 2)


def test_a_walk_without_neighbors_fails_without_checks(apart):
    for found in (by_distance(apart), lazily(apart)):
        assert not found.success
        assert int(found.edge_checks) == 0
        assert GOAL not in np.asarray(found.path)
