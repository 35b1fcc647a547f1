"""The guidance network against NumPy, and the laws it must keep on padded roadmaps."""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy.ndimage import correlate
from scipy.spatial.transform import Rotation

from gnnjax.errors import InputError
from gnnjax.paper.graphs import graphs_tuple
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.paper.occupancy import HalvingConv, occupancy_grid
from gnnjax.roadmap.graph import Roadmap
from gnnjax.scene.scene import Scene, box_scene

LOWER, UPPER = (-1.2, -1.2, -0.4), (1.2, 1.2, 1.6)
drawn = jax.jit(occupancy_grid, static_argnums=(1, 2, 3))
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


def random_scene(seed=0, num_boxes=4, padding=2) -> Scene:
    rng = np.random.default_rng(seed)
    total = num_boxes + padding
    quats = Rotation.random(total, rng=rng).as_quat(scalar_first=True)
    return box_scene(
        centers=jnp.asarray(rng.uniform(-0.8, 0.8, (total, 3)), jnp.float32),
        half_extents=jnp.asarray(rng.uniform(0.15, 0.5, (total, 3)), jnp.float32),
        quats=jnp.asarray(quats, jnp.float32),
        mask=jnp.asarray(np.arange(total) < num_boxes),
    )


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


# NumPy versions of the layers, from the equations.


def linear(layer, x):
    bias = 0.0 if layer.bias is None else np.asarray(layer.bias[...], np.float64)
    return x @ np.asarray(layer.kernel[...], np.float64) + bias


def norm(layer, x):
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    return x * np.asarray(layer.scale[...]) + np.asarray(layer.bias[...])


def relu(x):
    return np.maximum(x, 0.0)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def softmax(x):
    weights = np.exp(x - x.max())
    return weights / weights.sum()


def gru(cell, hidden, x):
    c = len(hidden)
    i, h = linear(cell.dense_i, x), linear(cell.dense_h, hidden)
    reset, update = sigmoid(i[:c] + h[:c]), sigmoid(i[c : 2 * c] + h[c : 2 * c])
    return (1.0 - update) * np.tanh(i[2 * c :] + reset * h[2 * c :]) + update * hidden


def attend(net, encoding, path, node):
    """Attention* of a node after a path, with the GRU run over the whole path again."""
    hidden, codes = np.zeros(net.channels), []
    for walked in path:
        hidden = gru(net.gru, hidden, np.asarray(encoding.code[walked]))
        codes.append(hidden)
    codes = np.reshape(codes[-net.max_path :], (-1, net.channels))
    o = np.asarray(encoding.environment[node])
    keys = linear(net.key_environment, o)
    queries = np.vstack([linear(net.query_environment, o), linear(net.query_path, codes)])
    values = np.vstack([linear(net.value_environment, o), linear(net.value_path, codes)])
    weights = softmax(queries @ keys / np.sqrt(net.channels))
    return norm(net.attention_norm, weights @ values + o)


def decode(net, encoding, path, roadmap, nodes, node, neighbor):
    """The guidance value of one edge."""
    x_i, x_j = attend(net, encoding, path, node), attend(net, encoding, [], neighbor)
    first = linear(net.decoder_node, x_i) + linear(net.decoder_difference, x_i - x_j)
    first = first + linear(net.decoder_environment, np.asarray(encoding.environment[node]))
    geometry = None
    if net.geometric_features:
        q, goal = nodes / np.pi, nodes[1] / np.pi
        near, far = np.linalg.norm(q[node] - goal), np.linalg.norm(q[neighbor] - goal)
        length = np.linalg.norm(q[node] - q[neighbor])
        geometry = np.array([length, near, far, (near - far) / length])
        if net.workspace_points:
            slot = np.argmax(np.asarray(roadmap.neighbors[node]) == neighbor)
            geometry = np.append(geometry, encoding.through[node, slot])
        first = first + linear(net.decoder_near_data, np.append(q[node], goal))
        first = first + linear(net.decoder_far_data, np.append(q[neighbor], goal))
        first = first + linear(net.decoder_geometry, geometry)
    decoded = relu(linear(net.decoder_out, relu(first)))
    value = linear(net.value_out, relu(linear(net.value_hidden, decoded)))
    if net.geometric_features:
        value = value + linear(net.value_geometry, geometry)
    return value[0]


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
    np.testing.assert_array_equal(model.net.encode_obstacles(random_scene()), np.zeros(8))
    here, there = (model.encode(model.params, roadmap, random_scene(seed)) for seed in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, here, there)


@pytest.mark.parametrize("without", ["path", "attention"])
def test_without_path_or_attention_a_node_knows_only_itself(without):
    model = make_model("paper", [without])
    net, roadmap = model.net, make_roadmap(*random_graph())
    encoding = model.encode(model.params, roadmap, random_scene())
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


@pytest.mark.parametrize("size", [8, 5, 2])
def test_convolution_agrees_with_scipy(size):
    conv = HalvingConv(2, 3, rngs=nnx.Rngs(0))
    grid = np.random.default_rng(0).normal(size=(size, size, size, 2)).astype(np.float32)
    kernel = np.asarray(conv.linear.kernel[...]).reshape(3, 3, 3, 2, 3)  # z, y, x, in, out
    expected = [
        sum(
            correlate(grid[..., a], kernel[..., a, b].transpose(2, 1, 0), mode="constant")
            for a in range(2)
        )[::2, ::2, ::2]
        for b in range(3)
    ]
    close(jax.jit(conv)(grid), np.stack(expected, axis=-1))


def test_occupancy_grid_agrees_with_brute_force():
    scene, m = random_scene(), 6
    low, high = np.array(LOWER), np.array(UPPER)
    expected = np.zeros((m, m, m))
    for index in np.ndindex(m, m, m):
        center = low + (np.array(index) + 0.5) * (high - low) / m
        for b in np.flatnonzero(scene.mask):
            rotation = Rotation.from_quat(scene.quats[b], scalar_first=True)
            local = rotation.inv().apply(center - np.asarray(scene.centers[b]))
            expected[index] += np.all(np.abs(local) <= np.maximum(scene.half_extents[b], 0.2))
    assert 0.02 < np.mean(expected > 0) < 0.9
    np.testing.assert_array_equal(drawn(scene, LOWER, UPPER, m), expected > 0)


def test_a_thin_pillar_between_voxel_centers_is_drawn():
    scene = random_scene(num_boxes=1, padding=0)._replace(
        centers=jnp.array([[0.0, 0.0, 0.6]]),
        half_extents=jnp.array([[0.01, 0.01, 1.0]]),
        quats=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
    )
    grid = drawn(scene, LOWER, UPPER, 8)
    assert grid.sum() == 2 * 2 * 8  # the pillar stands on an edge that four columns share


@pytest.mark.parametrize("steps", [0, 1, 4, len(WALK)])
def test_a_search_step_agrees_with_numpy_over_the_whole_path(model, steps):
    nodes, adjacent = random_graph()
    roadmap = make_roadmap(nodes, adjacent)
    encoding = model.encode(model.params, roadmap, random_scene())
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
    encoding = model.encode(model.params, roadmap, random_scene())
    outputs = model.outputs(model.params, encoding, roadmap)
    for node in range(11):
        state = model.walk(model.params, encoding, [node])
        expected = model.values(model.params, encoding, state, roadmap)[node]
        close(outputs.values[node], np.where(roadmap.neighbor_mask[node], expected, 0.0))


def test_validity_is_the_same_in_both_directions(models):
    model = models["workspace"]
    nodes, adjacent = random_graph()
    roadmap = make_roadmap(nodes, adjacent)
    encoding = model.encode(model.params, roadmap, random_scene())
    validity = model.outputs(model.params, encoding, roadmap).validity
    logits = np.full(adjacent.shape, np.nan)
    for i, k in np.argwhere(roadmap.neighbor_mask):
        logits[i, roadmap.neighbors[i, k]] = validity[i, k]
    close(logits, logits.T)
    assert np.nanstd(logits) > 1e-2


def test_padding_changes_nothing(models):
    model = models["workspace"]
    nodes, adjacent = random_graph()
    tight, scene = make_roadmap(nodes, adjacent), random_scene()
    loose = make_roadmap(nodes, adjacent, num_slots=11, num_nodes=17)
    padded_scene = jax.tree.map(lambda x: np.concatenate([x, np.zeros_like(x[:3])]), random_scene())
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
        encoding = model.encode(model.params, roadmap, random_scene())
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
    scenes = [random_scene(seed) for seed in range(3)]

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
    codes = [model.encode(model.params, roadmap, random_scene()) for roadmap in (six, seven)]
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
    outputs = model.outputs(params, model.encode(params, roadmap, random_scene()), roadmap)
    distance = np.linalg.norm(nodes - nodes[1], axis=1)
    expected = np.where(roadmap.neighbor_mask, -distance[roadmap.neighbors], 0.0)
    close(outputs.values, expected)


def test_every_weight_is_reached_by_a_gradient(models):
    model = models["workspace"]
    roadmap, scene = make_roadmap(*random_graph()), random_scene()

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
