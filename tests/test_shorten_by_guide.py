"""Path roadmaps searched on the host, against the compiled search of roadmaps and plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.devices import map_first
from gnnjax.planning.shorten_by_guide import PathRoadmaps
from gnnjax.roadmap.graph import GOAL, START
from gnnjax.search.knowledge import INVALID, UNKNOWN, VALID, Knowledge
from gnnjax.search.path_roadmap import path_roadmap
from gnnjax.search.rounds import Priced, cheapest_route

NUM, POINTS = 12, 9


@jax.jit
def compiled_routes(points, price, status, node_status):
    roadmaps = jax.vmap(path_roadmap)(points)
    known = Knowledge(status, node_status)
    priced = Priced(roadmaps, price, jnp.ones(price.shape, bool), known)
    return map_first(cheapest_route, jnp.int32(NUM), priced)


@pytest.fixture
def pool():
    """Twelve path roadmaps; every other edge and node is known, and slot 5 is free."""
    rng = np.random.default_rng(0)
    points = rng.random((NUM, POINTS, 3), np.float32)
    price = rng.exponential(0.3, (NUM, POINTS, POINTS)).astype(np.float32)
    made = PathRoadmaps(np.arange(NUM), points, price + price.swapaxes(1, 2))
    status = rng.choice(3, p=[0.4, 0.1, 0.5], size=price.shape).astype(np.int8)
    status = np.triu(status, 1)
    made._known.status[:] = status + status.swapaxes(1, 2)
    made._known.node_status[:, 2:] = rng.choice(3, p=[0.6, 0.2, 0.2], size=(NUM, POINTS - 2))
    made._known.status[2, START] = made._known.status[2, :, START] = INVALID  # no way
    made.ids[5] = -1
    return made


def test_routes_are_those_of_the_compiled_search(pool):
    route = pool.route()
    known = pool._known
    expected = compiled_routes(pool._points, pool._price, *known)
    expected = jax.tree.map(np.asarray, expected)
    live = np.arange(NUM) != 5
    found = route.num[live] > 0
    assert found.sum() == NUM - 2
    for name in ("path", "num", "points", "node_unknown", "edge_unknown", "unjudged"):
        np.testing.assert_array_equal(
            getattr(route, name)[live][found], getattr(expected, name)[live][found]
        )
    np.testing.assert_allclose(route.edge_price[live], expected.edge_price[live], rtol=1e-6)
    np.testing.assert_array_equal(route.num[live], expected.num[live])
    assert not any(part[5].any() for part in route)


def test_what_is_learned_of_an_edge_is_learned_both_ways(pool):
    route = pool.route()
    before = [x.copy() for x in pool._known]
    nodes, edges = np.zeros((2, *route.path.shape), np.int8)
    for row in np.flatnonzero(route.num):
        edges[row, 0] = VALID if row % 2 else INVALID
        if route.num[row] > 2:
            nodes[row, 1] = INVALID
    pool.learn(route, nodes, edges)
    status, node_status = before
    for row in np.flatnonzero(route.num):
        first = route.path[row, 1]
        status[row, START, first] = status[row, first, START] = VALID if row % 2 else INVALID
        if route.num[row] > 2:
            node_status[row, first] = INVALID
    np.testing.assert_array_equal(pool._known.status, status)
    np.testing.assert_array_equal(pool._known.node_status, node_status)
    # What is blocked is not on the next path.
    again = pool.route()
    for row in np.flatnonzero(again.num):
        path = again.path[row, : again.num[row]]
        assert (node_status[row, path] != INVALID).all()
        assert (status[row, path[:-1], path[1:]] != INVALID).all()
        assert (path[0], path[-1]) == (START, GOAL)


def test_nothing_is_known_of_paths_at_first():
    points = np.zeros((2, 4, 3), np.float32)
    made = PathRoadmaps(np.array([7, 8]), points, np.zeros((2, 4, 4), np.float32))
    assert (made._known.status == UNKNOWN).all()
    np.testing.assert_array_equal(made._known.node_status, [[VALID, VALID, 0, 0]] * 2)
    # Points that are one and the same: straight to the goal.
    assert made.route().num.tolist() == [2, 2]
