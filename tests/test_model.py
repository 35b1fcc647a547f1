"""The guidance network against NumPy, and the laws it must keep on padded roadmaps."""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from gnnjax.errors import InputError
from gnnjax.paper.graphs import graphs_tuple
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.roadmap.graph import Roadmap
from tests.draws import boxes_and_padding
from tests.numpy_network import decode, linear, norm, relu, softmax

WALK = [0, 3, 5, 2, 3, 7, 4, 9]  # longer than the memory of the model under test


def make_roadmap(nodes, adjacent, num_slots=8, num_nodes=None) -> Roadmap:
    """Fills the slots of a roadmap from an adjacency matrix, padded to `num_nodes`."""
    count = len(nodes)
    num_nodes = num_nodes or count
    rows = np.full((num_nodes, nodes.shape[1]), 0.7, np.float32)  # padding is not all zeros
    rows[:count] = nodes
    neighbors = np.tile(np.arange(num_nodes, dtype=np.int32)[:, None], (1, num_slots))
    mask = np.zeros((num_nodes, num_slots), bool)
    lengths = np.zeros((num_nodes, num_slots), np.float32)
    for i in range(count):
        ends = np.flatnonzero(adjacent[i])
        neighbors[i, : len(ends)], mask[i, : len(ends)] = ends, True
        lengths[i, : len(ends)] = np.linalg.norm(nodes[ends] - nodes[i], axis=1)
    return Roadmap(
        nodes=jnp.asarray(rows),
        node_mask=jnp.asarray(np.arange(num_nodes) < count),
        neighbors=jnp.asarray(neighbors),
        neighbor_mask=jnp.asarray(mask),
        lengths=jnp.asarray(lengths),
        num_dropped=jnp.asarray(np.int32(0)),
    )


def random_graph(seed=0, num_nodes=12, num_dof=7):
    """Nodes and a symmetric adjacency matrix with at most 7 neighbors; node 11 is isolated."""
    rng = np.random.default_rng(seed)
    nodes = rng.uniform(-2.5, 2.5, (num_nodes, num_dof)).astype(np.float32)
    adjacent = np.zeros((num_nodes, num_nodes), bool)
    for i, j in rng.permutation(np.argwhere(np.triu(np.ones((11, 11)), 1)))[:26]:
        if adjacent[i].sum() < 7 and adjacent[j].sum() < 7:
            adjacent[i, j] = adjacent[j, i] = True
    return nodes, adjacent


@jax.jit
def graph_of(roadmap):
    return graphs_tuple(roadmap, 70)


def small_network(kind: str, without=()) -> GuidanceNetwork:
    return GuidanceNetwork(
        channels=8,
        grid_size=8,
        max_path=6,
        geometric_features=kind != "paper",
        validity_head=kind != "paper",
        workspace_points=4 if kind == "workspace" else 0,
        without=without,
        rngs=nnx.Rngs(0),
    )


def fake_distances(scene, q):
    """Distances of four points of a make-believe arm to the first box."""
    return 0.3 * jnp.sin(q[:, :4] + scene.centers[0, 0])


def make_model(kind: str, without=()):
    """A small network with random weights everywhere, also where training starts from zero."""
    # The initializers would take longer to compile than the tests to run.
    graphdef, shapes = nnx.split(nnx.eval_shape(lambda: small_network(kind, without)))
    rng = np.random.default_rng(1)
    params = jax.tree.map(
        lambda x: jnp.asarray(rng.normal(size=x.shape) / np.sqrt(x.shape[0]), jnp.float32), shapes
    )

    def merged(params):
        return nnx.merge(graphdef, params)

    @jax.jit
    def extend(params, encoding, nodes, count):
        net = merged(params)

        def step(i, state):
            return net.extend_path(encoding, state, nodes[i])

        return jax.lax.fori_loop(0, count, step, net.init_path())

    def walk(params, encoding, path):
        """The state after a path, compiled once for paths of any length."""
        nodes = np.zeros(len(WALK), np.int32)
        nodes[: len(path)] = path
        return extend(params, encoding, nodes, len(path))

    def values(params, encoding, state, roadmap):
        """Guidance values of every node after one path."""
        nodes = jnp.arange(roadmap.nodes.shape[0])
        return jax.vmap(lambda n: merged(params).guidance_values(encoding, state, roadmap, n))(
            nodes
        )

    return SimpleNamespace(
        net=merged(params),
        graphdef=graphdef,
        params=params,
        encode=jax.jit(
            lambda p, r, s, e=None: merged(p).encode(r, s, e, fake_distances), static_argnums=3
        ),
        outputs=jax.jit(lambda p, c, r, e=None: merged(p).edge_outputs(c, r, e), static_argnums=3),
        walk=walk,
        attend=jax.jit(lambda p, *at: merged(p).attend(*at)),
        embed=jax.jit(lambda p, *graph: merged(p).embed_nodes(*graph)),
        values=jax.jit(values),
    )


@pytest.fixture(scope="module")
def models():
    return {kind: make_model(kind) for kind in ("paper", "extended", "workspace")}


@pytest.fixture(params=["paper", "extended", "workspace"])
def model(request, models):
    return models[request.param]


def close(actual, expected, tolerance=2e-5):
    np.testing.assert_allclose(actual, expected, rtol=tolerance, atol=tolerance)


def test_node_codes_agree_with_numpy(models):
    net = models["paper"].net
    nodes, adjacent = random_graph()
    roadmap = make_roadmap(nodes, adjacent)
    data = np.hstack([nodes, np.tile(nodes[1], (len(nodes), 1))]) / np.pi
    close(jax.jit(net.node_data)(roadmap), data)

    connected = adjacent | np.eye(len(nodes), dtype=bool)
    wh = linear(net.gat_weight, data)
    attended = np.zeros_like(wh)
    for i in range(len(nodes)):
        ends = np.flatnonzero(connected[i])
        e = np.array([linear(net.gat_attention, np.append(wh[i], wh[j]))[0] for j in ends])
        attended[i] = relu(softmax(np.where(e > 0.0, e, 0.01 * e)) @ wh[ends])
    degree = connected.sum(1)
    expected = (connected / np.sqrt(np.outer(degree, degree))) @ linear(net.gcn_weight, attended)
    actual = models["paper"].embed(models["paper"].params, graph_of(roadmap), np.float32(data))
    close(actual, relu(expected))


@pytest.mark.parametrize("without", ["gat", "gcn"])
def test_a_network_without_a_graph_layer_has_a_linear_one_on_each_node(without):
    model = make_model("paper", [without])
    net = model.net
    nodes, adjacent = random_graph()
    roadmap = make_roadmap(nodes, adjacent)
    data = np.asarray(jax.jit(net.node_data)(roadmap), np.float64)
    connected = adjacent | np.eye(len(nodes), dtype=bool)
    degree = connected.sum(1)
    code = linear(net.gat_weight, data)
    if without == "gat":
        averaging = connected / np.sqrt(np.outer(degree, degree))
        expected = averaging @ linear(net.gcn_weight, relu(code))
        assert not hasattr(net, "gat_attention")
    else:
        for i in range(len(nodes)):
            ends = np.flatnonzero(connected[i])
            wh = linear(net.gat_weight, data[ends])
            own = np.broadcast_to(linear(net.gat_weight, data[i]), wh.shape)
            e = linear(net.gat_attention, np.hstack([own, wh]))[:, 0]
            code[i] = softmax(np.where(e > 0.0, e, 0.01 * e)) @ wh
        expected = linear(net.gcn_weight, relu(code))
    actual = model.embed(model.params, graph_of(roadmap), np.float32(data))
    close(actual, relu(expected))


def test_a_network_without_grid_sees_no_obstacles():
    model = make_model("paper", ["grid"])
    roadmap = make_roadmap(*random_graph())
    np.testing.assert_array_equal(model.net.encode_obstacles(boxes_and_padding()), np.zeros(8))
    here, there = (model.encode(model.params, roadmap, boxes_and_padding(seed)) for seed in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, here, there)


@pytest.mark.parametrize("without", ["path", "attention"])
def test_without_path_or_attention_a_node_knows_only_itself(without):
    model = make_model("paper", [without])
    net, roadmap = model.net, make_roadmap(*random_graph())
    encoding = model.encode(model.params, roadmap, boxes_and_padding())
    environment = np.asarray(encoding.environment[3], np.float64)
    own = linear(net.value_environment, environment) if without == "path" else 0.0
    states = [model.walk(model.params, encoding, path) for path in (WALK, [5])]
    assert [int(state.length) for state in states] == [len(WALK), 1]
    for state in states:
        attended = model.attend(model.params, encoding, state, 3)
        close(attended, norm(net.attention_norm, own + environment))
    values = [model.values(model.params, encoding, state, roadmap) for state in states]
    np.testing.assert_array_equal(*values)
    outputs = model.outputs(model.params, encoding, roadmap)
    close(outputs.values, jnp.where(roadmap.neighbor_mask, values[0], 0.0))


def test_unknown_parts_are_refused():
    with pytest.raises(InputError, match=r"no parts \['gru'\] to do without; there are \['gat',"):
        small_network("paper", ["gat", "gru"])


def test_points_of_the_arm_without_what_they_need_are_refused():
    with pytest.raises(InputError, match="workspace_points is 3 and needs validity_head and geom"):
        GuidanceNetwork(workspace_points=3, validity_head=False, rngs=nnx.Rngs(0))
    network = nnx.eval_shape(lambda: GuidanceNetwork(workspace_points=3, rngs=nnx.Rngs(0)))
    with pytest.raises(InputError, match="distances of 3 points of the arm; give point_distances"):
        network.encode(make_roadmap(*random_graph()), boxes_and_padding())


def test_environment_code_agrees_with_numpy(models):
    net = models["paper"].net
    nodes, adjacent = random_graph()
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(len(nodes), 8)), rng.normal(size=8)
    expected = np.zeros((len(nodes), 8))
    for i in range(len(nodes)):
        rows = [
            linear(net.pair_near, x[i]) + linear(net.pair_far, x[j]) + linear(net.pair_obstacles, y)
            for j in np.flatnonzero(adjacent[i])
        ]
        # An isolated node has no pair: its mean is zero before the last layer.
        hidden = np.mean([relu(norm(net.pair_norm, row)) for row in rows] or [np.zeros(8)], axis=0)
        expected[i] = linear(net.pair_out, hidden)
    graph = graph_of(make_roadmap(nodes, adjacent))
    actual = jax.jit(net.encode_environment)(graph, np.float32(x), np.float32(y))
    close(actual, expected)


@pytest.mark.parametrize("steps", [0, 1, 4, len(WALK)])
def test_a_search_step_agrees_with_numpy_over_the_whole_path(model, steps):
    nodes, adjacent = random_graph()
    roadmap = make_roadmap(nodes, adjacent)
    encoding = model.encode(model.params, roadmap, boxes_and_padding())
    path = WALK[:steps]
    state = model.walk(model.params, encoding, path)
    assert state.length == steps
    values = model.values(model.params, encoding, state, roadmap)
    for i, k in [(0, 0), (3, 1), (9, 0)]:
        assert roadmap.neighbor_mask[i, k]
        j = int(roadmap.neighbors[i, k])
        expected = decode(model.net, encoding, path, roadmap, nodes, i, j)
        close(values[i, k], expected, 1e-4)


def test_edge_outputs_agree_with_a_search_that_starts_at_each_node(model):
    roadmap = make_roadmap(*random_graph())
    encoding = model.encode(model.params, roadmap, boxes_and_padding())
    outputs = model.outputs(model.params, encoding, roadmap)
    for node in range(11):
        state = model.walk(model.params, encoding, [node])
        expected = model.values(model.params, encoding, state, roadmap)[node]
        close(outputs.values[node], np.where(roadmap.neighbor_mask[node], expected, 0.0))


def test_validity_is_the_same_in_both_directions(models):
    model = models["workspace"]
    nodes, adjacent = random_graph()
    roadmap = make_roadmap(nodes, adjacent)
    encoding = model.encode(model.params, roadmap, boxes_and_padding())
    validity = model.outputs(model.params, encoding, roadmap).validity
    logits = np.full(adjacent.shape, np.nan)
    for i, k in np.argwhere(roadmap.neighbor_mask):
        logits[i, roadmap.neighbors[i, k]] = validity[i, k]
    close(logits, logits.T)
    assert np.nanstd(logits) > 1e-2


def test_padding_changes_nothing(models):
    model = models["workspace"]
    nodes, adjacent = random_graph()
    tight, scene = make_roadmap(nodes, adjacent), boxes_and_padding()
    loose = make_roadmap(nodes, adjacent, num_slots=11, num_nodes=17)
    padded_scene = jax.tree.map(
        lambda x: np.concatenate([x, np.zeros_like(x[:3])]), boxes_and_padding()
    )
    results = []
    for roadmap, boxes, max_edges in [(tight, scene, None), (loose, padded_scene, 60)]:
        encoding = model.encode(model.params, roadmap, boxes, max_edges)
        outputs = model.outputs(model.params, encoding, roadmap, max_edges)
        state = model.walk(model.params, encoding, WALK)
        values = model.values(model.params, encoding, state, roadmap)
        values = np.where(roadmap.neighbor_mask, values, 0.0)
        assert all(np.isfinite(x).all() for x in [*encoding, *outputs])
        tables = (outputs.values, outputs.validity, values)
        results.append((encoding.environment[:12], *(table[:12, :8] for table in tables)))
    for tight_result, loose_result in zip(*results, strict=True):
        close(loose_result, tight_result, 1e-5)


def test_renumbering_the_nodes_renumbers_the_values(model):
    nodes, adjacent = random_graph()
    order = np.concatenate([[0, 1], 2 + np.random.default_rng(5).permutation(len(nodes) - 2)])
    place = np.argsort(order)  # new number of each old node
    results = []
    for numbers in (np.arange(len(nodes)), order):
        roadmap = make_roadmap(nodes[numbers], adjacent[np.ix_(numbers, numbers)])
        encoding = model.encode(model.params, roadmap, boxes_and_padding())
        state = model.walk(model.params, encoding, np.argsort(numbers)[WALK])
        values = model.values(model.params, encoding, state, roadmap)
        table = np.zeros(adjacent.shape)
        for i, k in np.argwhere(roadmap.neighbor_mask):
            table[i, roadmap.neighbors[i, k]] = values[i, k]
        results.append(table)
    close(results[1][np.ix_(place, place)], results[0])


def test_a_batch_equals_a_loop(models):
    model = models["workspace"]
    roadmaps = [make_roadmap(*random_graph(seed)) for seed in range(3)]
    scenes = [boxes_and_padding(seed) for seed in range(3)]

    def one(roadmap, scene):
        encoding = model.encode(model.params, roadmap, scene)
        return encoding, model.outputs(model.params, encoding, roadmap)

    def stack(trees):
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)

    looped = stack([one(roadmap, scene) for roadmap, scene in zip(roadmaps, scenes, strict=True)])
    batched = jax.vmap(one)(stack(roadmaps), stack(scenes))
    jax.tree.map(close, batched, looped)


def test_a_six_joint_arm_is_a_seven_joint_arm_whose_last_joint_stays_at_zero(models):
    model = models["workspace"]
    nodes, adjacent = random_graph(num_dof=6)
    six = make_roadmap(nodes, adjacent)
    seven = make_roadmap(np.pad(nodes, ((0, 0), (0, 1))), adjacent)
    codes = [model.encode(model.params, roadmap, boxes_and_padding()) for roadmap in (six, seven)]
    jax.tree.map(close, *codes)


def test_too_many_joints_are_named(models):
    roadmap = make_roadmap(*random_graph(num_dof=8))
    with pytest.raises(InputError, match="up to 7 joints, the robot has 8"):
        models["paper"].net.node_data(roadmap)


def test_the_untrained_network_prefers_the_neighbor_nearest_to_the_goal(models):
    model = models["extended"]
    _, params = nnx.split(nnx.jit(lambda: small_network("extended"))())
    nodes, adjacent = random_graph()
    roadmap = make_roadmap(nodes, adjacent)
    outputs = model.outputs(params, model.encode(params, roadmap, boxes_and_padding()), roadmap)
    distance = np.linalg.norm(nodes - nodes[1], axis=1)
    expected = np.where(roadmap.neighbor_mask, -distance[roadmap.neighbors], 0.0)
    close(outputs.values, expected)


def test_every_weight_is_reached_by_a_gradient(models):
    model = models["workspace"]
    roadmap, scene = make_roadmap(*random_graph()), boxes_and_padding()

    def loss(params):
        net = nnx.merge(model.graphdef, params)
        encoding = net.encode(roadmap, scene, None, fake_distances)
        state, _ = jax.lax.scan(
            lambda s, n: (net.extend_path(encoding, s, n), None),
            net.init_path(),
            np.int32(WALK[:2]),
        )
        values = net.guidance_values(encoding, state, roadmap, WALK[2])
        validity = net.edge_outputs(encoding, roadmap).validity
        return jnp.sum(values**2) + jnp.sum(validity**2)

    for path, gradient in jax.tree.leaves_with_path(jax.jit(jax.grad(loss))(model.params)):
        assert np.isfinite(gradient).all(), jax.tree_util.keystr(path)
        assert np.any(gradient), jax.tree_util.keystr(path)


@pytest.mark.parametrize("extended", [False, True])
def test_the_config_rebuilds_the_network_and_it_is_small(extended):
    def build(**config):
        return nnx.eval_shape(lambda: GuidanceNetwork(**config, rngs=nnx.Rngs(0)))

    options = {"without": ("path", "gat")} if extended else {}
    net = build(channels=16, geometric_features=extended, validity_head=extended, **options)
    again = build(**json.loads(json.dumps(net.config)))  # as a checkpoint would store it
    assert again.config == net.config
    assert nnx.split(again)[0] == nnx.split(net)[0]
    older = {name: value for name, value in net.config.items() if name != "without"}
    assert build(**older).without == ()
    _, params = nnx.split(build())
    assert sum(4 * x.size for x in jax.tree.leaves(params)) < 1e6
