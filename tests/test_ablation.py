"""The ablation: its variants are what they are called, and a quick run measures and draws them."""

import json

from experiments.ablation import AblationConfig, _command, _training, run, variants
from gnnjax.train import PRESETS


def test_variants_share_the_budget_of_their_training():
    config = AblationConfig()
    for name, changes in variants(config).items():
        training = _training(config, name, PRESETS["default"].data, "kuka_iiwa14", changes)
        roadmaps = training.epochs * training.num_roadmaps
        assert roadmaps == 3000
        assert training.num_roadmaps % training.batch_size == 0  # no roadmap is left out
        assert training.seed == 0
    assert len({_training(config, n, config.data, "a", c).out for n, c in variants(config).items()})


def test_the_command_of_a_training_says_what_differs_from_its_preset():
    config = AblationConfig()
    name = "paper's network without gat"
    training = _training(config, name, config.data, "kuka_iiwa14", variants(config)[name])
    command = _command(training)
    assert command.startswith("python -m gnnjax.train --preset default ")
    for words in ("--no-geometric-features", "--without gat", "--num-roadmaps 1000", "--epochs 3"):
        assert words in command
    assert "--seed" not in command


def test_a_quick_run_measures_draws_and_goes_on(tiny_path, tmp_path, monkeypatch):
    config = AblationConfig(
        quick=True,
        robot=str(tiny_path),
        data=tmp_path / "data",
        runs=tmp_path / "runs",
        trained=tmp_path / "trained",
        results=tmp_path / "results",
    )
    run(config)
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
    monkeypatch.setattr("experiments.ablation.train", None)
    run(config)
    assert (config.out / "ablation.json").read_text() == first  # nothing was run again
