"""Limits of motions: those of a model are taken, and what is none is refused in a sentence."""

import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.scene.scene import make_scene
from gnnjax.trajectory.execution import execute_trajectory
from gnnjax.trajectory.limits import ANY_TORQUE, Limits, limits_of
from gnnjax.trajectory.trajectory import time_path
from tests.conftest import TINY

NOTHING = make_scene([], [])


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({}, r"tiny has no velocity limits; give velocity=\.\.\. \(rad/s\), or put <numeric"),
        ({"velocity": 1.0}, r"no acceleration limits; give acceleration=\.\.\. \(rad/s\^2; makers"),
        ({"velocity": 0.0}, r"velocity limits of tiny are 0.0; give one positive number, or 3"),
        ({"velocity": [1, 1]}, r"velocity limits of tiny are \[1, 1\]; give one positive"),
        ({"velocity": 1, "acceleration": [1, -1, 1]}, "acceleration limits of tiny are"),
        ({"velocity": 1, "acceleration": np.nan}, "acceleration limits of tiny are nan"),
        ({"velocity": 1, "acceleration": 1, "torque": np.inf}, "torque limits of tiny are inf"),
        ({"velocity": 1, "acceleration": 1, "jerk": 0}, "jerk limits of tiny are 0; give one"),
        ({"velocity": 1, "acceleration": "much"}, "acceleration limits of tiny are 'much'"),
        ({"velocity": 1, "acceleration": 1, "blend": -1.0}, "blend is -1.0; give a length"),
        ({"velocity": 1, "acceleration": 1, "margin": -1.0}, "margin is -1.0; give a clearance"),
    ],
)
def test_limits_that_are_none_are_refused(tiny, limits, message):
    with pytest.raises(InputError, match=message):
        time_path(tiny, NOTHING, np.zeros((2, 3)), **limits)


def test_the_torques_of_a_model_that_has_some_are_limited(tmp_path):
    path = tmp_path / "some.xml"
    motor = '<motor joint="b" gear="10" ctrlrange="-0.5 0.4"/><motor joint="c"/>'
    path.write_text(TINY.replace("</mujoco>", f"<actuator>{motor}</actuator></mujoco>"))
    robot = load_robot(path)
    free = limits_of(robot, velocity=1.0, acceleration=1.0).torque
    np.testing.assert_array_equal(free, [ANY_TORQUE, 4.0, ANY_TORQUE])
    found = time_path(robot, NOTHING, [[0, 0, 0], [1, 0, 0]], velocity=1.0, acceleration=1.0)
    assert "joint b needs" in found.reason
    assert "and has 4; carry less" in found.reason
    upright = [[0, -1.5, 0], [1, -1.5, 0]]
    loose = {"velocity": 3.0, "acceleration": 9.0}
    found = time_path(robot, NOTHING, upright, **loose)
    same = time_path(robot, NOTHING, upright, **loose, torque=[900.0, 4.0, 900.0])
    assert found.duration == pytest.approx(same.duration)
    with pytest.raises(InputError, match="has no torque limits for joint a, without"):
        execute_trajectory(robot, NOTHING, found)


@pytest.mark.parametrize(
    "motor",
    [
        '<motor joint="b" forcerange="0 10"/>',
        '<motor joint="b" forcerange="-20 -10"/>',
        '<motor joint="b" gear="-10" ctrlrange="0 1"/>',
        '<motor joint="b" forcerange="-9 9"/><motor joint="b" forcerange="5 10"/>',
    ],
)
def test_a_motor_that_pushes_one_way_only_is_refused_unless_torques_are_given(tmp_path, motor):
    path = tmp_path / "one_way.xml"
    path.write_text(TINY.replace("</mujoco>", f"<actuator>{motor}</actuator></mujoco>"))
    robot, fault = load_robot(path), r"motors of joint b of one_way push one way only, .* give torq"
    assert robot.torque_limit is None
    with pytest.raises(InputError, match=fault):
        limits_of(robot, velocity=1.0, acceleration=1.0)
    with pytest.raises(InputError, match=fault):
        robot.at_rest_within(0.5)
    given = limits_of(robot, velocity=1.0, acceleration=1.0, torque=20.0).torque
    np.testing.assert_array_equal(given, [20.0] * 3)
    assert robot.at_rest_within(0.5, torque=20.0).rest_limit is not None


def test_limits_of_a_model_are_taken_where_none_are_given():
    robot = load_robot("franka_panda")
    limits = limits_of(robot, acceleration=3.0)
    assert isinstance(limits, Limits)
    np.testing.assert_allclose(limits.velocity, robot.velocity_limit)
    np.testing.assert_allclose(limits.torque, robot.torque_limit)
    np.testing.assert_array_equal(limits.acceleration, np.full(7, 3.0))
