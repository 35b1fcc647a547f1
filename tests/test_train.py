"""Training: its losses against plain loops, and its runs from data to weights."""

import dataclasses
import functools
import inspect
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import gnnjax.train
import gnnjax.training.run
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.generate import GenerateConfig, generate
from gnnjax.paper.graphs import edge_bucket
from gnnjax.paper.losses import graph_losses, step_targets, walk_losses
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.paper.step import LOSS_OPTIONS
from gnnjax.planning.load import load_planner
from gnnjax.problems.labelled import from_problem_set
from gnnjax.problems.shards import load_problems
from gnnjax.roadmap.graph import GOAL
from gnnjax.train import PRESETS, make_optimizer, parse, train
from gnnjax.training.weights import load_network, read_metadata
from tests.tensorboard_events import read_events

jitted_targets = jax.jit(step_targets, static_argnums=1)


@pytest.fixture(scope="module", autouse=True)
def compiled_once():
    """Trainings that differ in nothing but their folders share what they compile."""
    optimizers, steps, planners = {}, {}, {}
    make_step, make_planner = gnnjax.train.make_step, gnnjax.train.SampledPlanner

    def shared_optimizer(config, num_steps):
        key = dataclasses.replace(config, out=Path(), resume=False), num_steps
        return optimizers.setdefault(key, make_optimizer(config, num_steps))

    def shared_step(graphdef, optimizer, robot, points, options, mesh):
        key = graphdef, id(optimizer), robot, points, tuple(options.items()), mesh
        made = make_step(graphdef, optimizer, robot, points, options, mesh)
        return steps.setdefault(key, made)

    def shared_planner(robot, strategy, options):
        return planners.setdefault(options, make_planner(robot, strategy, options))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gnnjax.train, "make_optimizer", shared_optimizer)
        patch.setattr(gnnjax.train, "make_step", shared_step)
        patch.setattr(gnnjax.train, "SampledPlanner", shared_planner)
        yield


@pytest.fixture(scope="module")
def data_path(tiny_path, tmp_path_factory):
    out = tmp_path_factory.mktemp("data") / "train"
    generate(
        GenerateConfig(robot=str(tiny_path), num_problems=8, num_nodes=30, shard_size=8, out=out)
    )
    return out


@pytest.fixture(scope="module")
def graphs(tiny_path, data_path):
    return from_problem_set(load_problems(data_path, load_robot(tiny_path)))


def graph(graphs, i):
    return jax.tree.map(lambda x: jnp.asarray(x[i]), graphs)


@pytest.fixture(scope="module")
def network():
    return GuidanceNetwork(channels=8, rngs=nnx.Rngs(1))


def log_softmax(values, mask):
    values = np.where(mask, np.asarray(values, float), -np.inf)
    return values - np.log(np.exp(values - values.max()).sum()) - values.max()


@pytest.mark.parametrize("temperature", [0.0, 0.3])
def test_targets_point_along_the_shortest_path(graphs, temperature):
    for i in range(4):
        data = graph(graphs, i)
        target, counts = jitted_targets(data, temperature)
        cost, following = np.asarray(data.labels.cost_to_go), np.asarray(data.labels.next_node)
        for node in range(30):
            assert counts[node] == (np.isfinite(cost[node]) and node != GOAL)
            if not counts[node]:
                continue
            best = np.asarray(data.roadmap.neighbors[node]) == following[node]
            if temperature == 0:
                np.testing.assert_array_equal(target[node], best & data.roadmap.neighbor_mask[node])
                continue
            through = np.asarray(
                data.roadmap.lengths[node] + cost[np.asarray(data.roadmap.neighbors[node])]
            )
            weight = np.exp(-(through - cost[node]) / temperature)
            weight *= np.asarray(data.labels.edge_valid[node])
            np.testing.assert_allclose(target[node], weight / weight.sum(), atol=1e-5)


@pytest.mark.parametrize("every_step", [True, False])
def test_the_walk_learns_from_the_nodes_that_a_plain_loop_visits(graphs, network, every_step):
    learned = 0
    encode = jax.jit(lambda network, *graph: network.encode(*graph, edge_bucket(200)))
    extend = jax.jit(lambda network, *path: network.extend_path(*path))
    values_at = jax.jit(lambda network, *at: network.guidance_values(*at))
    for i in range(6):
        data = graph(graphs, i)
        target, counts = jitted_targets(data, 0.0)
        encoding = encode(network, data.roadmap, data.problem.scene)
        state = extend(network, encoding, network.init_path(), 0)
        node, visited, losses = 0, {0}, []
        for step in range(4):
            values = np.asarray(values_at(network, encoding, state, data.roadmap, node))
            loss = -(target[node] * log_softmax(values, data.roadmap.neighbor_mask[node]))
            loss = np.nansum(np.where(np.asarray(target[node]) > 0, loss, 0))
            neighbors = np.asarray(data.roadmap.neighbors[node])
            open_ = np.asarray(data.labels.edge_valid[node]) & ~np.isin(neighbors, list(visited))
            following = neighbors[np.argmax(np.where(open_, values, -np.inf))]
            last = step == 3 or following == GOAL or not open_.any()
            if (every_step or last) and counts[node]:
                losses.append(loss)
            if last:
                break
            node = int(following)
            visited.add(node)
            state = extend(network, encoding, state, node)
        found, number = jax.jit(walk_losses, static_argnums=(0, 6, 7))(
            network, encoding, data, target, counts, jnp.int32(4), 10, every_step
        )
        np.testing.assert_allclose(found, sum(losses), rtol=1e-4)
        assert number == len(losses)
        learned += len(losses)
    assert learned >= 4


def test_all_losses_are_finite_and_validity_ignores_padding(graphs, network):
    data = graph(graphs, 0)
    options = {name: getattr(PRESETS["smoke"], name) for name in LOSS_OPTIONS}
    losses = jax.jit(functools.partial(graph_losses, **options))(network, data, jax.random.key(0))
    assert all(np.isfinite(value) for value in losses.values())
    mask = data.roadmap.neighbor_mask

    @jax.jit
    def edge_outputs(network, roadmap, scene):
        encoding = network.encode(roadmap, scene, edge_bucket(200))
        return network.edge_outputs(encoding, roadmap, edge_bucket(200))

    outputs = edge_outputs(network, data.roadmap, data.problem.scene)
    logits, valid = np.asarray(outputs.validity)[mask], np.asarray(data.labels.edge_valid)[mask]
    expected = np.log1p(np.exp(np.where(valid, -logits, logits))).mean()
    np.testing.assert_allclose(losses["validity_loss"], expected, rtol=1e-4)


@pytest.fixture(scope="module")
def smoke(tiny_path, data_path, tmp_path_factory):
    """A finished run of two epochs."""
    config = dataclasses.replace(
        PRESETS["smoke"],
        data=data_path,
        robot=str(tiny_path),
        out=tmp_path_factory.mktemp("runs") / "smoke",
        validation_problems=8,  # as many as are planned below, with what is compiled here
        without=("gat",),  # the ablation trains whole networks
    )
    train(config)
    return config


def records(config):
    lines = (config.out / "log.jsonl").read_text().splitlines()
    return [{k: v for k, v in json.loads(line).items() if k != "seconds"} for line in lines]


def test_a_run_logs_validates_and_leaves_weights_that_plan(tiny_path, smoke):
    first, second = records(smoke)
    assert second["loss"] != first["loss"]
    assert 0 <= second["validation_success"] <= 1
    (events,) = (smoke.out / "tensorboard").iterdir()
    losses = [e.simple_value for e in read_events(events) if e.tag == "loss"]
    np.testing.assert_allclose(losses, [first["loss"], second["loss"]], rtol=1e-6)
    data = load_problems(smoke.data, load_robot(tiny_path)).problems
    # The other planner that takes them has just validated them.
    planner = load_planner(
        tiny_path, "gnn_lazy", num_nodes=30, weights=smoke.out / "weights.safetensors"
    )
    plans = planner.plan_batch(data)
    assert sum(plan.success for plan in plans) >= 4
    meta = read_metadata(smoke.out / "weights.safetensors")
    assert meta["training"]["epochs"] == 2
    assert (meta["model"]["channels"], meta["model"]["without"]) == (8, ["gat"])


def test_a_validation_that_solves_nothing_has_no_cost(monkeypatch):
    unsolved = SimpleNamespace(success=False, edge_checks=4, cost=np.inf)
    planner = SimpleNamespace(plan_batch=lambda problems: 3 * [unsolved])
    found = inspect.unwrap(gnnjax.train.validate)(planner, None)
    assert found == {"success": 0.0, "edge_checks": 4.0}


def test_a_resumed_run_comes_to_the_same_numbers(smoke, tmp_path, monkeypatch, capfd):
    config = dataclasses.replace(smoke, out=tmp_path / "cut")
    validate, calls = gnnjax.train.validate, []

    def killed(*args):
        calls.append(None)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return validate(*args)

    monkeypatch.setattr(gnnjax.train, "validate", killed)
    with pytest.raises(KeyboardInterrupt):
        train(config)
    assert len(records(config)) == 1
    monkeypatch.undo()
    # As if killed while the second checkpoint was written.
    (config.out / "checkpoints" / "2.orbax-checkpoint-tmp").mkdir()
    (config.out / "checkpoints" / "2.orbax-checkpoint-tmp" / "half").write_text("half")
    with pytest.raises(InputError, match="holds a run already; add --resume"):
        train(config)
    with pytest.raises(InputError, match=r"has learning_rate 0\.003, not 1\.0"):
        train(dataclasses.replace(config, resume=True, learning_rate=1.0))
    capfd.readouterr()
    train(dataclasses.replace(config, resume=True))
    assert capfd.readouterr().err == ""
    assert records(config) == records(smoke)
    weights = [
        jax.tree.leaves(nnx.state(load_network(c.out / "weights.safetensors"), nnx.Param))
        for c in (config, smoke)
    ]
    for ours, theirs in zip(*weights, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_number_of_roadmaps_is_checked(smoke):
    config = dataclasses.replace(smoke, num_roadmaps=9)
    with pytest.raises(InputError, match="num_roadmaps is 9; choose 1 to 8, the roadmaps in"):
        train(config)


def test_the_command_line_leaves_parts_out_and_keeps_the_preset(monkeypatch):
    words = "train --preset paper --without gat path --num-roadmaps 100 --epochs 3"
    monkeypatch.setattr("sys.argv", words.split())
    config = parse()
    assert config == dataclasses.replace(
        PRESETS["paper"], without=("gat", "path"), num_roadmaps=100, epochs=3
    )
    for words, message in (
        ("--without gru", "invalid choice 'gru' for argument '--without'"),
        ("--preset papers", r"no preset 'papers'; there are \['default', 'paper', 'smoke'\]"),
    ):
        monkeypatch.setattr("sys.argv", ["train", *words.split()])
        with pytest.raises(InputError, match=message):
            parse()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epochs": 0}, "epochs is 0; it must be at least 1"),
        ({"validate_every": 0}, "validate_every is 0"),
        ({"validation_problems": -1}, "validation_problems is -1"),
        ({"max_walk": -3}, "max_walk is -3"),
        ({"channels": 0}, "channels is 0; it must be at least 4"),
        ({"channels": 6}, "channels is 6; it must be a multiple of 4"),
        ({"num_dof": 0}, "num_dof is 0"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"weight_decay": float("inf")}, "weight_decay is inf"),
        ({"validity_weight": 0.0}, "workspace_points is 12 and needs validity_weight > 0"),
        ({"seed": -1}, "seed is -1"),
        ({"batch_size": 9}, "batch_size is 9; choose 1 to 8"),
        (
            {"data": Path("missing")},
            "no training data at 'missing'; make some with python -m gnnjax.generate",
        ),
    ],
)
def test_bad_settings_are_refused(tiny_path, data_path, tmp_path, change, message):
    settings = {"data": data_path, "robot": str(tiny_path), "out": tmp_path / "run"} | change
    with pytest.raises(InputError, match=message):
        train(dataclasses.replace(PRESETS["smoke"], **settings))
    assert not (tmp_path / "run").exists()


def test_a_run_cannot_go_into_a_file(tiny_path, data_path, tmp_path):
    (tmp_path / "file").write_text("kept")
    config = dataclasses.replace(
        PRESETS["smoke"], data=data_path, robot=str(tiny_path), out=tmp_path / "file"
    )
    with pytest.raises(InputError, match="is a file; name a folder"):
        train(config)
    assert (tmp_path / "file").read_text() == "kept"


def test_the_paper_preset_is_the_papers():
    paper = PRESETS["paper"]
    assert (paper.optimizer, paper.learning_rate, paper.weight_decay) == ("sgd", 1e-3, 1e-3)
    assert (paper.max_walk, paper.every_step, paper.all_nodes) == (10, False, False)
    assert (paper.temperature, paper.validity_weight) == (0.0, 0.0)
    assert not paper.geometric_features
