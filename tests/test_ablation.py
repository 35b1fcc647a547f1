"""Networks that are trained to be compared: variants are what they are called, and quick runs
measure and draw them."""

import copy
import json

import jax
import numpy as np
import pytest
from flax import nnx

import gnnjax.train
from experiments import converged
from experiments.ablation import EXPERIMENT
from experiments.record import run
from experiments.training import command
from experiments.variants import AblationConfig, training, variants
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.planning.load import load_planner
from gnnjax.train import PRESETS, train
from gnnjax.training.weights import save_network


def test_variants_share_the_budget_of_their_training():
    config = AblationConfig()
    for name, changes in variants(config).items():
        made = training(config, name, PRESETS["default"].data, "kuka_iiwa14", changes)
        roadmaps = made.epochs * made.num_roadmaps
        assert roadmaps == 3000
        assert made.num_roadmaps % made.batch_size == 0  # no roadmap is left out
        assert made.seed == 0
    assert len({training(config, n, config.data, "a", c).out for n, c in variants(config).items()})


def test_the_command_of_a_training_says_what_differs_from_its_preset():
    config = AblationConfig()
    name = "paper's network without gat"
    made = training(config, name, config.data, "kuka_iiwa14", variants(config)[name])
    line = command(made)
    assert line.startswith("python -m gnnjax.train --preset default ")
    for words in ("--no-geometric-features", "--without gat", "--num-roadmaps 1000", "--epochs 3"):
        assert words in line
    assert "--seed" not in line


@pytest.mark.usefixtures("experiments_remember", "stand_ins")
def test_a_quick_run_measures_draws_and_goes_on(tiny_path, tmp_path, monkeypatch):
    config = AblationConfig(
        quick=True,
        robot=str(tiny_path),
        data=tmp_path / "data",
        runs=tmp_path / "runs",
        trained=tmp_path / "trained",
        results=tmp_path / "results",
    )
    # Planners have tests of their own; the cheapest one stands in for those that have a network.
    planner = load_planner(tiny_path, "distance", num_nodes=30, max_roadmaps=1)
    asked = []

    def make_planner(robot, options):
        asked.append(options)
        return planner

    monkeypatch.setattr("gnnjax.evaluate.make_planner", make_planner)
    trainings = []

    def traced_step(*args):
        """A step that is traced, and changes nothing: what it learns has tests of its own."""
        step = make_step(*args)

        def idle(state, data, keys):
            _, losses = jax.eval_shape(step, state, data, keys)
            return state, {name: np.zeros(x.shape, x.dtype) for name, x in losses.items()}

        return idle

    def train_the_first(made):
        """Training, also of networks that lack a part, has tests of its own."""
        trainings.append(made.without)
        if not made.without:
            return train(made)
        names = ("num_dof", "channels", "geometric_features", "workspace_points", "without")
        options = {name: getattr(made, name) for name in names}
        network = nnx.eval_shape(
            lambda: GuidanceNetwork(**options, validity_head=True, rngs=nnx.Rngs(0))
        )
        zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), nnx.state(network, nnx.Param))
        nnx.update(network, zeros)
        save_network(made.out / "weights.safetensors", network, {"log": [{}]})
        return made.out / "weights.safetensors"

    make_step = gnnjax.train.make_step
    monkeypatch.setattr("gnnjax.train.make_step", traced_step)
    monkeypatch.setattr("experiments.training.train", train_the_first)
    run(EXPERIMENT, config)
    assert trainings == [(), ("gat",)]
    assert [options.planner for options in asked] == ["gnn", "gnn", "distance"]
    assert len({options.weights for options in asked}) == 3
    assert all((o.num_nodes, o.max_roadmaps) == (30, 1) for o in asked)
    first = (config.out / "ablation.json").read_text()
    rows = json.loads(first)["rows"]
    assert [row["variant"] for row in rows] == [
        "default",
        "default without gat",
        "no network, distance to the goal",
    ]
    assert rows[0]["difference"]["edge_checks"]["mean"] == 0
    assert rows[1]["num_weights"] < rows[0]["num_weights"]
    assert (config.out / "ablation.png").stat().st_size > 1000
    monkeypatch.setattr("experiments.training.train", None)
    run(EXPERIMENT, config)
    assert (config.out / "ablation.json").read_text() == first  # nothing was run again


def test_the_longer_training_is_the_presets_but_for_epochs_and_seed():
    config = converged.ConvergedConfig()
    made = converged.training(config, "kuka_iiwa14", config.data / "kuka_iiwa14_train", 2)
    assert command(made) == (
        "python -m gnnjax.train --preset paper --out runs/converged/kuka_iiwa14_60epochs_seed2 "
        "--seed 2 --epochs 60"
    )


@pytest.mark.usefixtures("experiments_remember", "stand_ins")
def test_a_network_that_adds_nothing_is_found_out(tiny_path, tmp_path, monkeypatch):
    folders = {key: tmp_path / key for key in ("data", "runs", "trained", "results")}
    config = converged.ConvergedConfig(quick=True, robot=str(tiny_path), **folders)
    planner = load_planner(tiny_path, "distance", num_nodes=30, max_roadmaps=1)
    monkeypatch.setattr("gnnjax.evaluate.make_planner", lambda robot, options: planner)
    trainings = []

    def train(made):
        """Training has tests of its own."""
        trainings.append((made.preset, made.epochs, made.seed, made.resume))
        assert (made.data / "manifest.json").exists()
        network = GuidanceNetwork(num_dof=3, channels=made.channels, rngs=nnx.Rngs(0))
        weights = made.out / "weights.safetensors"
        made.out.mkdir(parents=True)
        save_network(weights, network, {"log": [{"epoch": made.epochs, "loss": 0.79}]})
        return weights

    monkeypatch.setattr("experiments.training.train", train)
    results = run(converged.EXPERIMENT, config)
    assert run(converged.EXPERIMENT, config) == results
    assert trainings == [("paper", 1, 0, True)]
    assert [row["variant"] for row in results["rows"]] == [
        "distance to the goal",
        "paper's network, training seed 0",
    ]
    # The stand-in is the distance itself.
    assert results["rows"][1]["difference"]["edge_checks"]["mean"] == 0
    assert "0.790" in converged.table(results)
    assert (config.out / "converged.png").stat().st_size > 10_000
    assert converged.verdict(results).startswith("Holds: paper's network, training seed 0 (loss")
    better = copy.deepcopy(results)
    better["rows"][1]["difference"]["success"] |= {"low": 0.01}
    assert converged.verdict(better).startswith("Does not hold: ")
