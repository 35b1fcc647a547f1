"""Lazy search in rounds: against SciPy, and the search that checks one edge at a time."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from gnnjax.devices import map_first
from gnnjax.roadmap.graph import GOAL, START, connect
from gnnjax.search.knowledge import INVALID, UNKNOWN, VALID, Knowledge, nothing_known
from gnnjax.search.rounds import (
    Priced,
    cheapest_route,
    keep_cheapest,
    learn,
    reprice,
)

NUM, NUM_NODES, SLOTS = 8, 50, 20

find_routes = jax.jit(lambda priced: map_first(cheapest_route, jnp.int32(NUM), priced))
learn_all, reprice_all = jax.jit(jax.vmap(learn)), jax.jit(jax.vmap(reprice))


@jax.jit
def make_roadmaps(key):
    """Random roadmaps; the last ones have edges so short that some have no path."""

    def one(key, radius):
        return connect(
            jax.random.uniform(key, (NUM_NODES, 3)), jnp.ones(NUM_NODES, bool), radius, SLOTS
        )

    return jax.vmap(one)(jax.random.split(key, NUM), jnp.linspace(0.5, 0.2, NUM))


@pytest.fixture(scope="module")
def roadmaps():
    return make_roadmaps(jax.random.key(0))


def both_ways(roadmaps, draws):
    """The same value for both directions of an edge, `[P N K]`, from `draws [P N N]`."""
    own, near = np.arange(NUM_NODES)[:, None], np.asarray(roadmaps.neighbors)
    return draws[np.arange(NUM)[:, None, None], np.minimum(own, near), np.maximum(own, near)]


@pytest.fixture(scope="module")
def priced(roadmaps):
    draws = np.random.default_rng(1).exponential(0.5, (NUM, NUM_NODES, NUM_NODES))
    price = both_ways(roadmaps, draws.astype(np.float32))
    known = jax.vmap(nothing_known)(roadmaps)
    ends = known.node_status.at[:, : GOAL + 1].set(VALID)
    return Priced(
        roadmaps,
        jnp.asarray(price),
        jnp.zeros(price.shape, bool),
        known._replace(node_status=ends),
    )


@pytest.fixture(scope="module")
def partly_known(priced):
    """The same with a third of the edges and nodes known."""
    rng = np.random.default_rng(2)
    chances = [0.65, 0.2, 0.15]
    draws = rng.choice(3, p=chances, size=(NUM, NUM_NODES, NUM_NODES)).astype(np.int8)
    nodes = rng.choice(3, p=chances, size=(NUM, NUM_NODES)).astype(np.int8)
    nodes[:, : GOAL + 1] = VALID
    known = Knowledge(jnp.asarray(both_ways(priced.roadmap, draws)), jnp.asarray(nodes))
    return priced._replace(known=known)


def plain(tree, p):
    return jax.tree.map(lambda x: np.asarray(x[p]), tree)


def cheapest(one):
    """SciPy's least costs from the start by what is known, and the nodes before."""
    roadmap, (status, nodes) = one.roadmap, one.known
    cost = np.where(status == UNKNOWN, roadmap.lengths + one.price, roadmap.lengths)
    keep = roadmap.neighbor_mask & (status != INVALID) & (nodes != INVALID)[:, None]
    keep &= (nodes != INVALID)[roadmap.neighbors]
    first, slot = np.nonzero(keep)
    graph = csr_matrix(
        (cost[first, slot].astype(float), (first, roadmap.neighbors[first, slot])),
        shape=(NUM_NODES, NUM_NODES),
    )
    return dijkstra(graph, indices=START, return_predecessors=True)


def shortest(one):
    """The least cost from start to goal."""
    return cheapest(one)[0][GOAL]


def check_route(one, route):
    """Whether there is a path; what all routes have to keep, against plain NumPy."""
    roadmap, (status, nodes) = one.roadmap, one.known
    path = route.path[: route.num]
    expected = shortest(one)
    if not len(path):
        assert np.isinf(expected)
        assert GOAL not in route.path
        for part in route[4:]:
            assert not part.any()
        return False
    assert (path[0], path[-1]) == (START, GOAL)
    assert (route.path[route.num :] == -1).all()
    slots = route.slots[: route.num - 1]
    assert roadmap.neighbor_mask[path[:-1], slots].all()
    np.testing.assert_array_equal(roadmap.neighbors[path[:-1], slots], path[1:])
    found = status[path[:-1], slots]
    assert INVALID not in found
    assert INVALID not in nodes[path]
    price = np.where(found == UNKNOWN, one.price[path[:-1], slots], 0)
    cost = roadmap.lengths[path[:-1], slots].sum() + price.sum()
    np.testing.assert_allclose(cost, expected, rtol=1e-5)
    # Step by step, and nothing beyond the last.
    np.testing.assert_array_equal(route.points[: route.num], roadmap.nodes[path])
    np.testing.assert_array_equal(
        route.points[route.num :], np.tile(roadmap.nodes[GOAL], (NUM_NODES - route.num, 1))
    )
    judged = one.judged[path[:-1], slots]
    for ours, expected in (
        (route.node_unknown, nodes[path] == UNKNOWN),
        (route.edge_unknown, found == UNKNOWN),
        (route.edge_price, price),
        (route.unjudged, (found == UNKNOWN) & ~judged),
    ):
        np.testing.assert_array_equal(ours[: len(expected)], expected)
        assert not ours[len(expected) :].any()
    return True


def test_the_cheapest_routes_are_those_of_dijkstra(priced, partly_known):
    rng = np.random.default_rng(3)
    judged = both_ways(priced.roadmap, rng.random((NUM, NUM_NODES, NUM_NODES)) < 0.5)
    partly_known = partly_known._replace(judged=jnp.asarray(judged))
    found = []
    for some in (priced, partly_known):
        routes = find_routes(some)
        found += [check_route(plain(some, p), plain(routes, p)) for p in range(NUM)]
    assert 8 <= sum(found) < 2 * NUM
    assert plain(routes, 0).edge_unknown.any()


def test_a_route_does_not_depend_on_the_batch(partly_known):
    routes = find_routes(partly_known)
    order = np.random.default_rng(4).permutation(NUM)
    turned = find_routes(jax.tree.map(lambda x: x[order], partly_known))
    for p in range(NUM):
        alone = find_routes(jax.tree.map(lambda x, p=p: jnp.stack([x[p]] * NUM), partly_known))
        for batch, shuffled, single in zip(routes, turned, alone, strict=True):
            np.testing.assert_array_equal(single[0], batch[p])
            np.testing.assert_array_equal(shuffled[order == p][0], batch[p])


def random_findings(routes, rng):
    """Something about about half of the steps of each route."""
    nodes, edges = rng.choice(3, size=(2, *routes.path.shape)).astype(np.int8)
    on_path = np.arange(NUM_NODES) < np.asarray(routes.num)[:, None]
    leaves = np.arange(NUM_NODES) < np.asarray(routes.num)[:, None] - 1
    nodes[:, 0] = UNKNOWN
    return nodes * (on_path & (np.asarray(routes.path) > GOAL)), edges * leaves


def test_what_is_learned_of_an_edge_is_learned_both_ways(partly_known):
    routes = find_routes(partly_known)
    nodes, edges = random_findings(routes, np.random.default_rng(5))
    found = learn_all(partly_known, routes, nodes, edges)
    learned = 0
    for p in range(NUM):
        one, route = plain(partly_known, p), plain(routes, p)
        status, node_status = (np.array(part) for part in one.known)
        for step in range(NUM_NODES):
            if nodes[p, step]:
                node_status[route.path[step]] = nodes[p, step]
            if edges[p, step]:
                ends = route.path[step : step + 2]
                for near, far in (ends, ends[::-1]):
                    slots = (one.roadmap.neighbors[near] == far) & one.roadmap.neighbor_mask[near]
                    assert slots.sum() == 1
                    status[near, slots] = edges[p, step]
                    learned += 1
        np.testing.assert_array_equal(found.status[p], status)
        np.testing.assert_array_equal(found.node_status[p], node_status)
    assert learned > 10
    # Nothing found out, nothing changed.
    nothing = np.zeros_like(nodes)
    same = learn_all(partly_known, routes, nothing, nothing)
    for ours, theirs in zip(same, partly_known.known, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_no_route_meets_a_node_that_is_not_valid(priced):
    met = 0
    while True:
        routes = find_routes(priced)
        inner = (np.arange(NUM_NODES) == 1) & (np.asarray(routes.num)[:, None] > 2)
        if not inner.any():
            break
        met += inner.sum()
        nodes = np.where(inner, INVALID, UNKNOWN).astype(np.int8)
        known = learn_all(priced, routes, nodes, np.zeros_like(nodes))
        priced = priced._replace(known=known)
        after = find_routes(priced)
        for p in range(NUM):
            check_route(plain(priced, p), plain(after, p))
            assert not inner[p, 1] or routes.path[p, 1] not in np.asarray(after.path[p])
    assert met > 3 * NUM
    # What is left are the routes from start to goal in one step, and none.
    blocked = np.asarray(priced.known.node_status) == INVALID
    assert set(np.asarray(routes.num).tolist()) <= {0, 2}
    assert blocked.sum() == met


def random_truth(roadmaps, rng):
    """Whether nodes `[P N]` and edges `[P N K]` hold, and what a check of an edge takes."""
    nodes = rng.random((NUM, NUM_NODES)) < 0.8
    nodes[:, : GOAL + 1] = True
    edges = both_ways(roadmaps, rng.random((NUM, NUM_NODES, NUM_NODES)) < 0.6)
    return nodes, edges, both_ways(roadmaps, rng.integers(1, 9, (NUM, NUM_NODES, NUM_NODES)))


def search_one_at_a_time(one, nodes, edges, checks):
    """A plain search that finds SciPy's cheapest path anew after each thing that it tests: the
    path, how many edges and configurations that took, and what is known at the end."""
    roadmap, known = one.roadmap, Knowledge(*map(np.array, one.known))
    spent = np.zeros(2, int)
    while True:
        cost, before = cheapest(one._replace(known=known))
        if not np.isfinite(cost[GOAL]):
            return [], spent, known
        path = [GOAL]
        while path[-1] != START:
            path.append(before[path[-1]])
        path = np.array(path[::-1])
        slots = [
            int(np.flatnonzero((roadmap.neighbors[a] == b) & roadmap.neighbor_mask[a])[0])
            for a, b in itertools.pairwise(path)
        ]
        steps = path[:-1], np.array(slots)
        untested = np.flatnonzero(known.node_status[path] == UNKNOWN)
        unknown = np.flatnonzero(known.status[steps] == UNKNOWN)
        if len(untested):
            node = path[untested[0]]
            spent += 0, 1
            known.node_status[node] = VALID if nodes[node] else INVALID
        elif len(unknown):
            dearest = unknown[one.price[steps][unknown].argmax()]
            near, slot = path[dearest], slots[dearest]
            spent += 1, checks[near, slot]
            far = roadmap.neighbors[near, slot]
            back = (roadmap.neighbors[far] == near) & roadmap.neighbor_mask[far]
            known.status[near, slot] = known.status[far, back] = (
                VALID if edges[near, slot] else INVALID
            )
        else:
            return path, spent, known


def look_at(route, nodes, edges, checks):
    """What is found out of one route, up to the first that does not hold: nodes in their order,
    then edges, the dearest first. And how many edges and configurations that takes."""
    found, spent = np.zeros((2, NUM_NODES), np.int8), np.zeros(2, int)
    dearest = np.argsort(-route.edge_price, kind="stable")
    todo = [(0, step) for step in np.flatnonzero(route.node_unknown)]
    todo += [(1, step) for step in dearest if route.edge_unknown[step]]
    for is_edge, step in todo:
        node, slot = route.path[step], route.slots[step]
        holds = edges[node, slot] if is_edge else nodes[node]
        spent += (1, checks[node, slot]) if is_edge else (0, 1)
        found[is_edge, step] = VALID if holds else INVALID
        if not holds:
            break
    return found, spent


@pytest.mark.parametrize("seed", range(3))
def test_rounds_come_to_the_path_and_the_checks_of_one_edge_at_a_time(priced, seed):
    truth = random_truth(priced.roadmap, np.random.default_rng(10 + seed))
    expected = [
        search_one_at_a_time(plain(priced, p), *(part[p] for part in truth)) for p in range(NUM)
    ]
    spent, rounds = np.zeros((NUM, 2), int), 0
    while True:
        routes = find_routes(priced)
        host = jax.tree.map(np.asarray, routes)
        if not (host.node_unknown.any() or host.edge_unknown.any()):
            break
        looks = [look_at(plain(host, p), *(part[p] for part in truth)) for p in range(NUM)]
        found, now = (np.stack(part) for part in zip(*looks, strict=True))
        # Rounds of a problem that is through find out nothing more.
        spent, rounds = spent + now, rounds + 1
        known = learn_all(priced, routes, found[:, 0], found[:, 1])
        priced = priced._replace(known=known)
    success = np.array([len(path) > 0 for path, _, _ in expected])
    np.testing.assert_array_equal(host.num > 0, success)
    for p, (path, took, known) in enumerate(expected):
        np.testing.assert_array_equal(host.path[p][: host.num[p]], path)
        np.testing.assert_array_equal(spent[p], took)
        np.testing.assert_array_equal(priced.known.node_status[p], known.node_status)
        np.testing.assert_array_equal(priced.known.status[p], known.status)
    assert 2 < success.sum() < NUM
    assert rounds > 5


def test_a_closer_look_changes_the_prices_it_names_both_ways(priced):
    routes = find_routes(priced)
    host = jax.tree.map(np.asarray, routes)
    rng = np.random.default_rng(6)
    steps = np.full((NUM, 4), -1)
    for p in range(NUM):
        chosen = rng.permutation(max(0, host.num[p] - 1))[:3]
        steps[p, rng.permutation(4)[: len(chosen)]] = chosen  # -1 anywhere between them
    values = rng.random((NUM, 4)).astype(np.float32)
    values[:, 0] = 0.0
    found = reprice_all(priced, routes, steps, values)
    looked = 0
    for p in range(NUM):
        one = plain(priced, p)
        price, judged = one.price.copy(), one.judged.copy()
        for step, value in zip(steps[p], values[p], strict=True):
            if step < 0:
                continue
            ends = host.path[p, step : step + 2]
            for near, far in (ends, ends[::-1]):
                slot = (one.roadmap.neighbors[near] == far) & one.roadmap.neighbor_mask[near]
                price[near, slot], judged[near, slot] = value, True
                looked += 1
        np.testing.assert_array_equal(found.price[p], price)
        np.testing.assert_array_equal(found.judged[p], judged)
    assert looked > 2 * NUM
    for ours, theirs in zip(found.known, priced.known, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    # The next routes are the cheapest by the new prices.
    routes = find_routes(found)
    for p in range(NUM):
        check_route(plain(found, p), plain(routes, p))
    nothing = reprice_all(priced, routes, np.full((NUM, 4), -1), values)
    np.testing.assert_array_equal(nothing.price, priced.price)
    assert not nothing.judged.any()


def test_a_search_may_leave_a_node_by_its_cheapest_edges_alone(partly_known):
    kept = jax.jit(jax.vmap(lambda one: keep_cheapest(one, 6)))(partly_known)
    fewer = 0
    for p in range(NUM):
        one, some = plain(partly_known, p), plain(kept, p)
        blocked = ~one.roadmap.neighbor_mask | (one.known.status == INVALID)
        cost = np.where(blocked, np.inf, one.roadmap.lengths + one.price)
        for node in range(NUM_NODES):
            wanted = np.argsort(cost[node], kind="stable")[:6]
            wanted = wanted[np.isfinite(cost[node, wanted])]
            fewer += np.isfinite(cost[node]).sum() > 6
            usable = some.roadmap.neighbor_mask[node] & (some.known.status[node] != INVALID)
            assert usable.sum() == len(wanted)
            for ours, theirs in (
                (some.roadmap.neighbors, one.roadmap.neighbors),
                (some.roadmap.lengths, one.roadmap.lengths),
                (some.price, one.price),
                (some.judged, one.judged),
                (some.known.status, one.known.status),
            ):
                np.testing.assert_array_equal(ours[node][usable], theirs[node][wanted])
    assert fewer > 20
    # What an edge's test taught is noted at its other end only where the edge is left there.
    routes = find_routes(kept)
    nodes, edges = random_findings(routes, np.random.default_rng(6))
    found = learn_all(kept, routes, nodes, edges)
    alone = 0
    for p in range(NUM):
        one, route = plain(kept, p), plain(routes, p)
        status = np.array(one.known.status)
        for step in np.flatnonzero(edges[p]):
            near, far = route.path[step : step + 2]
            status[near, route.slots[step]] = edges[p, step]
            back = (one.roadmap.neighbors[far] == near) & one.roadmap.neighbor_mask[far]
            status[far, back] = edges[p, step]
            alone += not back.any()
        np.testing.assert_array_equal(found.status[p], status)
    assert alone > 0


def test_a_path_of_too_many_nodes_is_none(monkeypatch):
    num = 12
    nodes = jnp.linspace(0, 1, num)[:, None]
    nodes = jnp.concatenate([nodes[:1], nodes[-1:], nodes[1:-1]])  # the goal is node 1
    line = jax.jit(connect, static_argnums=3)(nodes, jnp.ones(num, bool), 0.1, 4)
    price = jnp.zeros(line.neighbors.shape)
    priced = Priced(line, price, price == 0, nothing_known(line))
    assert int(jax.jit(cheapest_route)(priced).num) == num
    monkeypatch.setattr("gnnjax.search.rounds.MOST_STEPS", num - 1)
    short = jax.jit(lambda priced: cheapest_route(priced))(priced)  # traced anew
    assert int(short.num) == 0
    assert not short.edge_unknown.any()
