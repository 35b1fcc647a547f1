"""The folder of a training: checkpoints, log and curves, whatever ends it."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
from flax import nnx

import gnnjax.train
import gnnjax.training.run
from gnnjax.errors import InputError
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.train import PRESETS, make_optimizer
from gnnjax.training.checkpoint import TrainingCheckpoints
from gnnjax.training.run import TrainingRun, TrainState
from gnnjax.training.weights import read_metadata
from tests.tensorboard_events import read_events


@pytest.fixture(scope="module")
def network():
    return GuidanceNetwork(channels=8, rngs=nnx.Rngs(1))


def test_a_kill_between_checkpoint_and_log_loses_no_record(network, tmp_path, monkeypatch):
    state = TrainState(nnx.state(network, nnx.Param), {})
    whole = [{"epoch": 1, "loss": 0.5}, {"epoch": 2, "loss": 0.25}]

    def killed(*args):
        raise KeyboardInterrupt

    with TrainingRun(tmp_path / "run", network, {"seed": 0}, "epoch") as run:
        run.begin(state, resume=False)
        run.add(whole[0], state)
        with monkeypatch.context() as patch:
            patch.setattr(gnnjax.training.run, "atomic_write", killed)
            with pytest.raises(KeyboardInterrupt):
                run.add(whole[1], state)
    (first,) = (tmp_path / "run" / "tensorboard").iterdir()
    ahead = first.rename(first.with_name("events.out.tfevents.3000000000.gnnjax"))  # by its clock
    with TrainingRun(tmp_path / "run", network, {"seed": 0}, "epoch") as run:
        assert run.begin(state, resume=True)[0] == 2
        run.finish(state.weights)
    log = (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in log] == whole
    assert read_metadata(tmp_path / "run" / "weights.safetensors")["training"]["log"] == whole[1:]
    (events,) = (tmp_path / "run" / "tensorboard").iterdir()
    assert events.name > ahead.name  # or TensorBoard, which is reading that, would not find it
    assert [e.simple_value for e in read_events(events) if e.tag == "loss"] == [0.5, 0.25]


def test_the_curves_are_drawn_with_each_checkpoint(network, tmp_path):
    state, figure = TrainState(nnx.state(network, nnx.Param), {}), tmp_path / "curves.svg"
    first = {"epoch": 1, "loss": 0.5, "walk_loss": float("nan"), "seconds": 30.0}
    second = {"epoch": 2, "loss": 0.25, "seconds": 60.0, "validation_cost": 7.0}
    with TrainingRun(tmp_path / "run", network, {}, "epoch", figure=figure) as run:
        run.begin(state, resume=False)
        run.add(first)
        assert not figure.exists()
        run.add(second, state)
        # Matplotlib says in comments what it writes as outlines.
        words = figure.read_text()
        assert "<!-- run: epoch 2, after 1.5 min -->" in words
        for title in ("training loss [nat]", "walk_loss", "validation: cost of the path [rad]"):
            assert words.count(f"<!-- {title} -->") == 1
        figure.unlink()
        run.finish(state.weights)
        assert figure.exists()


def test_two_trainings_do_not_share_a_folder(network, tmp_path):
    with TrainingRun(tmp_path / "run", network, {}, "epoch"):
        with pytest.raises(InputError, match=r"written by process .* choose another place"):
            with TrainingRun(tmp_path / "run", network, {}, "epoch"):
                pass


def test_an_old_checkpoint_that_was_half_removed_is_none(network, tmp_path, monkeypatch):
    state = TrainState(nnx.state(network, nnx.Param), {})
    checkpoints = TrainingCheckpoints(tmp_path, network, {})
    for epoch in (1, 2):
        checkpoints.save(epoch, state, [])

    def killed(folder, **kwargs):
        next(folder.iterdir()).rename(tmp_path.parent / f"{tmp_path.name}-removed")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            checkpoints.save(3, state, [])
    checkpoints = TrainingCheckpoints(tmp_path, network, {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["2", "3"]
    assert checkpoints.restore(state)[0] == 3


def test_a_run_that_began_before_an_option_was_there_goes_on(network, tmp_path):
    weights = nnx.state(network, nnx.Param)
    state = TrainState(weights, make_optimizer(PRESETS["smoke"], 10).init(weights))
    checkpoints = TrainingCheckpoints(tmp_path, network, {"seed": 0})
    checkpoints.save(1, state, [])
    checkpoints = TrainingCheckpoints(tmp_path, network, {"seed": 0, "without": ()})
    assert checkpoints.restore(state)[0] == 1
    settings = {"seed": 0, "without": ("gat",)}
    checkpoints = TrainingCheckpoints(tmp_path, network, settings)
    with pytest.raises(InputError, match=r"has without None, not \['gat'\]"):
        checkpoints.restore(state)


@pytest.mark.parametrize("name", ["adamw", "sgd"])
def test_the_state_of_every_optimizer_is_kept(network, tmp_path, name):
    weights = nnx.state(network, nnx.Param)
    optimizer = make_optimizer(dataclasses.replace(PRESETS["smoke"], optimizer=name), 10)
    state = TrainState(weights, jax.tree.map(lambda x: x + 1, optimizer.init(weights)))
    checkpoints = TrainingCheckpoints(tmp_path, network, {})
    checkpoints.save(3, state, [{"epoch": 3}])
    epoch, restored, log = checkpoints.restore(TrainState(weights, optimizer.init(weights)))
    assert (epoch, log) == (3, [{"epoch": 3}])
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    for ours, theirs in zip(*map(jax.tree.leaves, (restored, state)), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_full_disk_leaves_the_checkpoints_there_are(network, tmp_path, monkeypatch):
    state = TrainState(nnx.state(network, nnx.Param), {})
    full = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: full)
    checkpoints = TrainingCheckpoints(tmp_path / "run", network, {})
    with pytest.raises(OSError, match=r"No space left on device: .*run/1'"):
        checkpoints.save(1, state, [])
    assert checkpoints.latest() is None
