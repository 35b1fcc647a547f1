"""Motions in files."""

import csv
import json

import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.scene.scene import make_scene
from gnnjax.trajectory.files import save_trajectory
from gnnjax.trajectory.trajectory import sample_trajectory, time_path


@pytest.fixture(scope="module")
def motion(tiny_path):
    robot, path = load_robot(tiny_path), [[0, 0, 0], [1, 0.5, 0], [1.5, 0, 0.4]]
    return robot, time_path(robot, make_scene([], []), path, velocity=1.0, acceleration=2.0)


def test_all_kinds_of_files_hold_the_motion(motion, tmp_path):
    robot, trajectory = motion
    points = sample_trajectory(robot, trajectory, 0.02)
    for kind in ("npz", "csv", "json"):
        save_trajectory(robot, trajectory, tmp_path / f"motion.{kind}", dt=0.02)

    with np.load(tmp_path / "motion.npz") as arrays:
        assert arrays["joint_names"].tolist() == ["a", "b", "c"]
        for name, values in points._asdict().items():
            np.testing.assert_array_equal(arrays[name], values)

    with open(tmp_path / "motion.csv", newline="") as stream:
        head, *rows = csv.reader(stream)
    assert head[:4] == ["time", "positions:a", "positions:b", "positions:c"]
    np.testing.assert_array_equal(np.array(rows, float), np.column_stack(points))

    message = json.loads((tmp_path / "motion.json").read_text())
    assert message["joint_names"] == ["a", "b", "c"]
    assert len(message["points"]) == len(points.times)
    last = message["points"][-1]
    assert last["positions"] == points.positions[-1].tolist()
    assert last["effort"] == points.torques[-1].tolist()
    time = last["time_from_start"]
    assert time["sec"] + 1e-9 * time["nanosec"] == pytest.approx(trajectory.duration, abs=1e-9)
    assert all(isinstance(p["time_from_start"]["nanosec"], int) for p in message["points"])


@pytest.mark.parametrize("name", ["motion.txt", "motion", "motion.npz.gz"])
def test_other_endings_are_refused(motion, tmp_path, name):
    with pytest.raises(InputError, match=r"has the ending .*; give \.npz \(arrays\), \.csv"):
        save_trajectory(*motion, tmp_path / name)
    assert not list(tmp_path.iterdir())
