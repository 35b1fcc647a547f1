"""Weights on disk: what is written is read, by whoever it is for, and what is damaged is named."""

import json

import jax
import numpy as np
import pytest
from flax import nnx
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from gnnjax.errors import InputError
from gnnjax.guide.motion import MotionNetwork
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.training.checkpoint import TrainingCheckpoints
from gnnjax.training.run import TrainState
from gnnjax.training.weights import find_weights, load_network, read_metadata, save_network


@pytest.fixture(scope="module")
def network():
    return GuidanceNetwork(channels=8, rngs=nnx.Rngs(1))


@pytest.fixture
def path(network, tmp_path):
    save_network(tmp_path / "w.safetensors", network, {"run": 1})
    return tmp_path / "w.safetensors"


def assert_same(one, other):
    assert type(one) is type(other)
    assert one.config == other.config
    jax.tree.map(np.testing.assert_array_equal, nnx.state(one), nnx.state(other))


def rewrite(path, change):
    """Changes the description of a file of weights."""
    with safe_open(path, framework="numpy") as file:
        meta = json.loads(file.metadata()["gnnjax"])
    change(meta)
    save_file(load_file(path), path, metadata={"gnnjax": json.dumps(meta)})


def test_a_network_comes_back_as_it_was(network, path):
    assert_same(load_network(path), network)
    assert read_metadata(path)["training"] == {"run": 1}


def test_saving_again_replaces_the_weights(path):
    other = GuidanceNetwork(channels=8, rngs=nnx.Rngs(2))
    save_network(path, other, {"run": 2})
    assert read_metadata(path)["training"] == {"run": 2}
    assert_same(load_network(path), other)


def test_the_checkpoint_of_a_run_can_be_planned_with_too(network, tmp_path):
    state = TrainState(nnx.state(network, nnx.Param), {})
    TrainingCheckpoints(tmp_path / "run", network, {"run": 3}).save(1, state, [])
    assert_same(load_network(tmp_path / "run" / "1"), network)
    assert read_metadata(tmp_path / "run" / "1")["training"] == {"run": 3}


@pytest.mark.parametrize("name", ["motion", "kuka_iiwa14", "kuka_iiwa14_paper", "kinova_gen3"])
def test_shipped_weights_are_found_by_name(name):
    assert find_weights(name).is_file()
    kind = MotionNetwork if name == "motion" else GuidanceNetwork
    assert isinstance(load_network(name), kind)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        lambda data: data[:-4] + bytes(4),  # a number changed
        lambda data: b"\xff" * len(data),
        lambda data: b"",
        lambda data: data + b"more",
    ],
)
def test_damaged_weights_are_refused(path, damage):
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=r"w.safetensors' is damaged or no file of weights"):
        load_network(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda meta: meta.update(format=1), r"has format 1 .* this one reads format 2"),
        (lambda meta: meta.update(network="Oracle"), "describes no network of this version"),
        (lambda meta: meta["model"].update(channels="many"), "describes no network of this"),
        (lambda meta: meta["model"].update(channels=16), "its arrays are not those that were"),
        (lambda meta: meta.clear(), "has format None"),
    ],
)
def test_what_another_version_wrote_is_refused(path, change, message):
    rewrite(path, change)
    with pytest.raises(InputError, match=message):
        load_network(path)


def test_weights_that_are_not_there_are_refused_with_those_that_are(tmp_path):
    with pytest.raises(InputError, match=r"no weights .*missing'; train some .* \['kinova_gen3',"):
        load_network(tmp_path / "missing")
    with pytest.raises(InputError, match="is damaged or no checkpoint"):
        load_network(tmp_path)
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(InputError, match=r"folder of a training; name its 'weights.safetensors'"):
        load_network(tmp_path)
