"""The experiment that solves for poses that can be reached."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import inverse_kinematics as experiment
from experiments.inverse_kinematics import (
    InverseKinematicsConfig,
    by_mink,
    one_by_one,
    reachable_poses,
)
from experiments.record import run
from experiments.registry import EXPERIMENTS
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.pose.inverse import inverse_kinematics


@pytest.mark.usefixtures("small_figures")
def test_the_quick_form_writes_results_and_goes_on(tiny_path, tmp_path, monkeypatch):
    measured = []

    def stand_in(robot, poses):
        measured.append(robot.name)
        return [row | {"right": False} for row in one_by_one(robot, poses)]

    monkeypatch.setitem(experiment.MEASURES, "mink", stand_in)
    config = InverseKinematicsConfig(
        quick=True, robot=str(tiny_path), runs=tmp_path, results=tmp_path / "out"
    )
    quick = EXPERIMENTS["inverse_kinematics"]._replace(quick={"num_poses": 3})
    results = run(quick, config)
    assert run(quick, config) == results
    assert measured == ["tiny"]
    shares = {row["solver"]: row["right"] for row in results["rows"]}
    assert shares == {"gnnjax": 3, "gnnjax, all at once": 3, "mink": 0}
    assert "| tiny | mink | 0.0 | " in quick.table(results)
    assert "tiny: 100.0 % in " in quick.verdict(results)
    assert (tmp_path / "out" / "inverse_kinematics.png").exists()


def test_what_is_not_at_its_pose_or_beyond_a_limit_is_not_right(tiny_path):
    robot = load_robot(tiny_path)
    poses = reachable_poses(robot, 3, 0)
    q = [inverse_kinematics(robot, poses).q[i, :1] for i in range(3)]
    q[1] = q[1] + [0.0, 0.01, 0.0]
    q[2] = q[2][:0]
    rows = experiment._judged(robot, poses, q, [1.0, 2.0, 3.0])
    assert [row["right"] for row in rows] == [True, False, False]
    assert [row["num"] for row in rows] == [1, 1, 0]
    beyond = q[0] + [2 * np.pi, 0.0, 0.0]  # the same place
    assert not experiment._judged(robot, poses, [beyond, q[0], q[0]], [1.0] * 3)[0]["right"]


def test_mink_starts_anew_where_it_ends_in_collision_and_gives_up_in_the_end(
    tiny_path, monkeypatch
):
    """With a stand-in whose steps lead from home to the goal, and from elsewhere nowhere."""
    robot = load_robot(tiny_path)
    poses = reachable_poses(robot, 2, 0)
    goals = [inverse_kinematics(robot, poses).q[i, 0] for i in range(2)]
    started = []

    class Configuration:
        def __init__(self, model):
            self.q = np.zeros(model.nq)

        def update(self, q):
            self.q = q.copy()
            started.append(self.q)

        def integrate_inplace(self, speed, dt):
            self.q = self.q + dt * speed

    class Task:
        def __init__(self, name, kind, *costs, lm_damping):
            assert (name, kind) == ("lower", "body")

        def set_target(self, target):
            self.goal = goals[0] if np.allclose(target, poses.position[0]) else None

        def compute_error(self, configuration):
            off = 1.0 if self.goal is None else np.abs(configuration.q - self.goal).max()
            return np.full(6, off)

    fake = SimpleNamespace(
        Configuration=Configuration,
        FrameTask=Task,
        ConfigurationLimit=lambda model: None,
        SO3=lambda quat: None,
        SE3=SimpleNamespace(from_rotation_and_translation=lambda rotation, place: place),
        solve_ik=lambda configuration, tasks, *_, **__: (
            0.0 if tasks[0].goal is None else tasks[0].goal - configuration.q
        ),
    )
    monkeypatch.setitem(sys.modules, "mink", fake)
    rows = by_mink(robot, poses)
    assert [row["right"] for row in rows] == [True, False]
    assert len(started) == 2 + experiment._STARTS  # the first pose twice: once untimed
    np.testing.assert_array_equal(started[0], robot.home)


def test_without_mink_there_is_a_remedy(tiny_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mink", None)
    robot = load_robot(tiny_path)
    with pytest.raises(InputError, match=r"no mink .*; pip install 'gnnjax\[experiments\]'"):
        by_mink(robot, reachable_poses(robot, 1, 0))
