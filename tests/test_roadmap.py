"""Roadmaps and their labels, against SciPy and plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import cdist

from gnnjax.arm.robot import load_robot
from gnnjax.collision.edges import EdgeChecks
from gnnjax.paper.graphs import graphs_tuple
from gnnjax.problems.labelled import label_roadmap
from gnnjax.roadmap.graph import (
    connect,
    each_edge,
    edge_numbers,
    radius_for_degree,
    reverse_slots,
)
from gnnjax.roadmap.paths import cost_to_go, edge_validity, for_each_edge
from gnnjax.roadmap.smallest import smallest

jitted_connect, jitted_reverse = jax.jit(connect, static_argnums=3), jax.jit(reverse_slots)


def random_roadmap(seed, num=40, slots=24, radius=0.45, masked=0):
    nodes = np.random.default_rng(seed).random((num, 3), np.float32)
    return jitted_connect(nodes, np.arange(num) < num - masked, radius, slots)


def adjacency(roadmap, keep=None):
    num = len(roadmap.nodes)
    matrix = np.zeros((num, num))
    mask = np.asarray(roadmap.neighbor_mask if keep is None else keep)
    for i, k in zip(*np.nonzero(mask), strict=True):
        matrix[i, roadmap.neighbors[i, k]] = roadmap.lengths[i, k]
    return matrix


def test_all_pairs_within_the_radius_are_connected_when_slots_suffice():
    roadmap = random_roadmap(0, masked=3)
    nodes = np.asarray(roadmap.nodes, float)[:-3]
    expected = cdist(nodes, nodes)
    expected[expected > 0.45] = 0
    np.testing.assert_allclose(adjacency(roadmap)[:-3, :-3], expected, atol=1e-6)
    assert adjacency(roadmap)[-3:].sum() == 0
    assert roadmap.num_dropped == 0


def test_the_graph_stays_symmetric_when_slots_run_out_and_says_what_it_dropped():
    full, short = random_roadmap(1), random_roadmap(1, slots=6)
    matrix = adjacency(short)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert ((matrix > 0).sum(axis=1) <= 6).all()
    lost = ((adjacency(full) > 0).sum() - (matrix > 0).sum()) // 2
    assert short.num_dropped == lost
    assert lost > 0


def test_each_edge_is_listed_once_and_numbered_in_both_of_its_slots():
    roadmap = random_roadmap(2, slots=8, masked=3)
    edges = each_edge(roadmap)
    matrix = np.triu(adjacency(roadmap))
    assert set(zip(edges.first.tolist(), edges.second.tolist(), strict=True)) == set(
        zip(*(x.tolist() for x in np.nonzero(matrix)), strict=True)
    )
    np.testing.assert_array_equal(
        np.asarray(roadmap.neighbors)[edges.first, edges.slot], edges.second
    )
    numbers = edge_numbers(roadmap, edges)
    for i, k in np.ndindex(numbers.shape):
        ends = {i, int(roadmap.neighbors[i, k])}
        if roadmap.neighbor_mask[i, k]:
            assert {int(x[numbers[i, k]]) for x in (edges.first, edges.second)} == ends
        else:
            assert numbers[i, k] == len(edges.first)


def test_the_graph_stays_symmetric_where_neighbors_are_equally_far():
    grid = np.stack(np.meshgrid(*[np.arange(5.0)] * 2), axis=-1).reshape(-1, 2)
    nodes = np.float32(np.concatenate([grid, grid[:3]]))  # and some twice
    for slots in (3, 6, 28):
        roadmap = jitted_connect(nodes, np.ones(28, bool), 1.5, slots)
        joined = np.zeros((28, 28), int)
        for i, k in np.argwhere(np.asarray(roadmap.neighbor_mask)):
            joined[i, roadmap.neighbors[i, k]] += 1
        np.testing.assert_array_equal(joined, joined.T)
        assert joined.max() == 1
        apart = cdist(nodes, nodes)
        whole = ((apart <= 1.5) & (apart > 0)).sum()
        assert int(roadmap.num_dropped) == (whole - joined.sum()) // 2
    assert roadmap.num_dropped == 0


def test_reverse_slots_lead_back():
    roadmap = random_roadmap(2, slots=10)
    reverse = np.asarray(jitted_reverse(roadmap))
    for i, k in zip(*np.nonzero(np.asarray(roadmap.neighbor_mask)), strict=True):
        j, back = divmod(reverse[i, k], 10)
        assert j == roadmap.neighbors[i, k]
        assert roadmap.neighbors[j, back] == i


def test_graphs_tuple_holds_every_edge_once_each_way():
    roadmap = random_roadmap(3)
    graph = jax.tree.map(np.asarray, jax.jit(graphs_tuple, static_argnums=1)(roadmap, 1024))
    count = int(graph.n_edge[0])
    matrix = np.zeros((41, 41))
    np.add.at(matrix, (graph.receivers[:count], graph.senders[:count]), graph.edges[:count, 0])
    np.testing.assert_allclose(matrix[:40, :40], adjacency(roadmap), rtol=1e-6)
    assert (graph.senders[count:] == 40).all()
    assert int(graph.n_edge.sum()) == 1024


@pytest.mark.parametrize("num_nodes", [200, 1000])
def test_the_radius_gives_the_mean_degree(num_nodes):
    robot = load_robot("kuka_iiwa14")
    radius = radius_for_degree(robot, num_nodes, 14.0)
    unit = np.random.default_rng(0).random((num_nodes, robot.num_dof))
    nodes = np.float32(unit * robot.joint_range)
    roadmap = jitted_connect(nodes, np.ones(num_nodes, bool), radius, 96)
    assert abs(np.asarray(roadmap.neighbor_mask).sum(axis=1).mean() - 14.0) < 1.5


def test_nodes_in_one_place_are_not_joined_and_lead_no_way_in_circles():
    nodes = np.float32([[0, 0], [1, 0], [0, 0], [0.5, 0.1], [0.5, 0.1 + 1e-6]])
    roadmap = jitted_connect(nodes, np.ones(5, bool), 0.8, 4)
    found = set(zip(*np.nonzero(adjacency(roadmap, roadmap.neighbor_mask)), strict=True))
    apart = {(0, 3), (0, 4), (1, 3), (1, 4), (2, 3), (2, 4)}
    assert found == apart | {(b, a) for a, b in apart}
    labels = jax.jit(label_roadmap)(roadmap, roadmap.neighbor_mask)
    assert labels.next_node.tolist() in [[x, -1, y, 1, 1] for x in (3, 4) for y in (3, 4)]
    same = jitted_connect(nodes[[0, 2, 3, 4, 1]], np.ones(5, bool), 0.8, 4)  # start is goal
    assert (same.neighbors[0] == 1).any()


@pytest.mark.parametrize("seed", range(3))
def test_cost_to_go_and_next_node_agree_with_dijkstra(seed):
    roadmap = random_roadmap(seed)
    slots = roadmap.neighbors.shape[1]
    chance = np.random.default_rng(seed).random(roadmap.neighbors.shape).reshape(-1)
    # One draw an edge, the same from both ends.
    index = np.arange(chance.size).reshape(-1, slots)
    canonical = np.minimum(index, np.asarray(jitted_reverse(roadmap)))
    valid = np.asarray(roadmap.neighbor_mask) & (chance[canonical] < 0.3)
    labels = jax.jit(label_roadmap)(roadmap, jnp.asarray(valid))
    expected = dijkstra(csr_matrix(adjacency(roadmap, valid)), indices=1)
    np.testing.assert_allclose(labels.cost_to_go, expected, rtol=1e-5)
    for node, following in enumerate(np.asarray(labels.next_node)):
        if node == 1 or np.isinf(expected[node]):
            assert following == -1
            continue
        step = adjacency(roadmap, valid)[node, following]
        assert step > 0
        np.testing.assert_allclose(expected[node], step + expected[following], rtol=1e-5)


def test_every_undirected_edge_is_checked_once():
    roadmap = random_roadmap(4, num=60)

    def check_edges(starts, ends):
        middle = (starts + ends) / 2
        moves = jnp.any(starts != ends, axis=-1)
        return EdgeChecks(middle[:, 0] > 0.4, moves.astype(jnp.int32))

    labelled = jax.jit(edge_validity, static_argnums=1)(roadmap, check_edges)
    nodes = np.asarray(roadmap.nodes)
    middle = (nodes[:, None] + nodes[np.asarray(roadmap.neighbors)]) / 2
    expected = np.asarray(roadmap.neighbor_mask) & (middle[..., 0] > 0.4)
    np.testing.assert_array_equal(labelled.edge_valid, expected)
    undirected = int(roadmap.neighbor_mask.sum()) // 2
    assert int(labelled.num_edge_checks) == int(labelled.num_checks) == undirected


@pytest.mark.parametrize("seed", range(6))
def test_a_cost_to_go_that_stops_early_is_exact_at_the_start_and_on_its_way(seed):
    roadmap = random_roadmap(seed)
    slots = roadmap.neighbors.shape[1]
    draws = np.random.default_rng(seed).exponential(size=roadmap.neighbors.size)
    index = np.arange(draws.size).reshape(-1, slots)
    extra = draws[np.minimum(index, np.asarray(jitted_reverse(roadmap)))]
    extra = np.where(extra > 1.5, np.inf, extra).astype(np.float32)
    cost = np.asarray(roadmap.lengths) + extra
    num, mask = len(roadmap.nodes), np.asarray(roadmap.neighbor_mask) & np.isfinite(cost)
    senders, used = np.nonzero(mask)
    receivers = np.asarray(roadmap.neighbors)[senders, used]
    graph = csr_matrix((cost[senders, used].astype(float), (senders, receivers)), (num, num))
    expected, way = dijkstra(graph, indices=1, return_predecessors=True)
    for start in range(0, num, 7):
        found = np.asarray(early_cost_to_go(roadmap, jnp.asarray(cost), jnp.int32(start)))
        np.testing.assert_allclose(found[start], expected[start], rtol=1e-5)
        assert (found >= expected * (1 - 1e-5)).all()
        node = start
        while np.isfinite(expected[start]) and node != 1:
            node = way[node]
            np.testing.assert_allclose(found[node], expected[node], rtol=1e-5, atol=1e-7)


early_cost_to_go = jax.jit(lambda roadmap, cost, start: cost_to_go(roadmap, cost, 1, start))


@pytest.mark.parametrize("block", [16, 256])
def test_a_value_of_each_edge_agrees_with_a_loop(block):
    roadmap = random_roadmap(5, masked=4)

    def value(starts, ends):
        return jnp.sum(starts * ends, axis=-1) + 1.0

    found = np.asarray(jax.jit(lambda r: for_each_edge(r, value, block))(roadmap))
    nodes, expected = np.asarray(roadmap.nodes), np.zeros(found.shape)
    for i, k in zip(*np.nonzero(np.asarray(roadmap.neighbor_mask)), strict=True):
        expected[i, k] = nodes[i] @ nodes[roadmap.neighbors[i, k]] + 1.0
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("batched", [False, True])
def test_the_smallest_of_rows_are_those_of_top_k(batched):
    rng = np.random.default_rng(0)
    values = rng.integers(0, 9, (3, 40, 13)).astype(np.float32)  # many of them equal
    values[rng.random(values.shape) < 0.4] = np.inf
    values[:, 0] = np.inf
    values = jnp.asarray(values if batched else values[0])
    found, at = (jax.vmap(smallest, (0, None)) if batched else smallest)(values, 8)
    negative, wanted = jax.lax.top_k(-values, 8)
    np.testing.assert_array_equal(at, wanted)
    np.testing.assert_array_equal(found, -negative)


def test_what_is_not_a_number_is_not_the_smallest():
    found, at = smallest(jnp.array([[jnp.nan, 2.0, 1.0]]), 2)
    assert found.tolist() == [[1, 2]]
    assert at.tolist() == [[2, 1]]
