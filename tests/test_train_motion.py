"""Training of the motion network: what it learns from, its runs, and its checkpoints."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

import gnnjax.train_motion
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.guide.motion import MotionNetwork
from gnnjax.problems.families import BOX_FAMILIES
from gnnjax.train_motion import (
    TrainMotionConfig,
    area_under_curve,
    make_batches,
    make_validation,
    names_apart,
    train_motion,
)
from gnnjax.training.motions import make_scene_batches, motion_sampler
from gnnjax.training.weights import load_network, read_metadata
from tests.fine_scan import collides_anywhere


@pytest.fixture(scope="module", autouse=True)
def compiled_once():
    """Trainings that differ in nothing but their folders share what they compile.

    Their scenes are the paper's and of one family; those in which motions are compared with MuJoCo
    are of all.
    """

    made = {}

    def shared(make):
        def make_once(*args):
            key = (
                make,
                *(
                    dataclasses.replace(x, out=Path(), resume=False)
                    if isinstance(x, TrainMotionConfig)
                    else x
                    for x in args
                ),
            )
            if key not in made:
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr("gnnjax.training.motions.BOX_FAMILIES", BOX_FAMILIES[-1:])
                    made[key] = make(*args)
            return made[key]

        return make_once

    with pytest.MonkeyPatch.context() as patch:
        for make in (make_scene_batches, make_batches, make_validation):
            patch.setattr(gnnjax.train_motion, make.__name__, shared(make))
        yield made


@pytest.fixture(scope="module")
def finished(tiny_path, tmp_path_factory):
    """A finished run of one small arm."""
    config = TrainMotionConfig(
        robots=(str(tiny_path),),
        out=tmp_path_factory.mktemp("runs") / "motion",
        steps=24,
        scenes=2,
        motions=64,
        learning_rate=2e-2,
        num_points=3,
        channels=8,
        save_every=8,
    )
    train_motion(config)
    return config


def records(config):
    lines = (config.out / "log.jsonl").read_text().splitlines()
    return [{k: v for k, v in json.loads(line).items() if k != "seconds"} for line in lines]


def test_a_run_learns_logs_and_leaves_weights(finished):
    found = records(finished)
    assert [record["step"] for record in found] == [8, 16, 24]
    assert found[-1]["loss"] < found[0]["loss"]
    assert all(0 <= record["edge_auc_tiny"] <= 1 for record in found)
    assert found[-1]["edge_auc_tiny"] > 0.6
    meta = read_metadata(finished.out / "weights.safetensors")
    assert meta["network"] == "MotionNetwork"
    assert meta["model"] == {"num_points": 3, "channels": 8}
    assert meta["training"]["steps"] == 24
    assert isinstance(load_network(finished.out / "weights.safetensors"), MotionNetwork)


def test_scenes_to_train_and_to_validate_are_compiled_once(finished, compiled_once):
    (draw_scenes,) = (made for key, made in compiled_once.items() if key[0] is make_scene_batches)
    assert draw_scenes._cache_size() == 1


def test_a_resumed_run_comes_to_the_same_numbers(finished, tmp_path, monkeypatch):
    config = dataclasses.replace(finished, out=tmp_path / "cut")
    measure, calls = gnnjax.train_motion.area_under_curve, []

    def killed(*args):
        calls.append(None)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return measure(*args)

    with monkeypatch.context() as patch:
        patch.setattr(gnnjax.train_motion, "area_under_curve", killed)
        with pytest.raises(KeyboardInterrupt):
            train_motion(config)
    assert len(records(config)) == 1
    with pytest.raises(InputError, match="holds a run already; add --resume"):
        train_motion(config)
    with pytest.raises(InputError, match=r"has learning_rate 0\.02, not 1\.0"):
        train_motion(dataclasses.replace(config, resume=True, learning_rate=1.0))
    train_motion(dataclasses.replace(config, resume=True))
    assert records(config) == records(finished)
    weights = [
        jax.tree.leaves(nnx.state(load_network(c.out / "weights.safetensors"), nnx.Param))
        for c in (config, finished)
    ]
    for ours, theirs in zip(*weights, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_finished_run_is_drawn_without_a_further_step(finished, tmp_path):
    log, figure = records(finished), tmp_path / "curves.svg"
    train_motion(dataclasses.replace(finished, resume=True, figure=figure))
    assert records(finished) == log
    words = figure.read_text()
    assert "<!-- motion: step 24, after " in words
    assert "<!-- edge_auc_tiny -->" in words


def test_with_nothing_to_resume_a_run_starts_from_the_beginning(finished, tmp_path):
    config = dataclasses.replace(finished, out=tmp_path / "new", resume=True)
    train_motion(config)
    assert records(config) == records(finished)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"figure": Path("curves.doc")}, "picture 'curves.doc' has no known ending"),
        ({"steps": 0}, "steps is 0; it must be at least 1"),
        ({"scenes": 0}, "scenes is 0"),
        ({"motions": 1}, "motions is 1; it must be at least 2"),
        ({"channels": -1}, "channels is -1"),
        ({"num_points": 0}, "num_points is 0"),
        ({"save_every": 0}, "save_every is 0"),
        ({"learning_rate": float("nan")}, "learning_rate is nan"),
        ({"seed": -1}, "seed is -1"),
        ({"robots": ()}, "robots is empty; name at least one arm"),
        ({"robots": ("pr2",)}, "no robot 'pr2' in assets/; there are"),
    ],
)
def test_bad_settings_are_refused(finished, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        train_motion(dataclasses.replace(finished, out=tmp_path / "run", **change))
    assert not (tmp_path / "run").exists()


def test_a_run_cannot_go_into_a_file(finished, tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(InputError, match="is a file; name a folder"):
        train_motion(dataclasses.replace(finished, out=tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "kept"


def test_motions_are_free_where_mujoco_says_so(tiny_path):
    robot = load_robot(tiny_path)
    draw_scenes = make_scene_batches(robot)
    draw = jax.jit(motion_sampler(robot, 40, ((0.0, 0.0, 0.2), (0.5, 1.5, 0.8)), 0.5))
    agreed, valid = 0, []
    for seed in range(3):
        key = jax.random.key(seed)
        scene = jax.tree.map(lambda x: np.asarray(x)[0], draw_scenes(key[None], 1))
        motions = jax.tree.map(np.asarray, draw(key, scene))
        length = np.linalg.norm(motions.ends - motions.starts, axis=1)
        assert (length < 1.5 + 1e-5).all()
        for i in range(40):
            motion = np.stack([motions.starts[i], motions.ends[i]]).astype(float)
            assert ((motion >= robot.joint_lower) & (motion <= robot.joint_upper)).all()
            # The scan tests no motion without length.
            motion[1] += 1e-9 * (length[i] == 0)
            agreed += motions.valid[i] != collides_anywhere(robot, scene, motion, step=0.02)
            valid.append(motions.valid[i])
    assert agreed >= 0.98 * len(valid)  # the scan is finer than the test
    assert 0.2 < np.mean(valid) < 0.95


def test_the_area_under_the_curve_counts_pairs_in_order():
    rng = np.random.default_rng(0)
    for _ in range(5):
        scores, valid = rng.integers(0, 6, 30).astype(float), rng.random(30) < 0.4
        pairs = scores[valid][:, None] - scores[~valid]
        expected = np.mean((pairs > 0) + 0.5 * (pairs == 0))
        np.testing.assert_allclose(area_under_curve(scores, valid), expected)


def test_arms_whose_files_are_called_the_same_are_told_apart():
    assert names_apart(["kuka_iiwa14", "my/arm.xml"]) == ["kuka_iiwa14", "arm"]
    assert names_apart(["left/arm.xml", "right/arm.xml"]) == ["left/arm.xml", "right/arm.xml"]
