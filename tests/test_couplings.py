"""Joints that others are coupled to: by equalities, tendons and loops."""

import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from tests.gripper import EQUALITY, LOOP, TENDON, same_poses, written


@pytest.mark.parametrize(
    ("coupling", "right"), [(EQUALITY, 0.005 + 0.5 * 0.03), (TENDON, 0.03), (LOOP, 0.03)]
)
def test_fingers_that_are_coupled_are_held_at_home(tmp_path, caplog, coupling, right):
    robot = load_robot(written(tmp_path, coupling))
    assert robot.joint_names == ("turn", "bend", "slip")
    assert robot.held == pytest.approx({"left": 0.03, "right": right})
    assert "joints that are not planned for are held: left at 0.03, right at" in caplog.text
    np.testing.assert_allclose(robot.home, [0.1, 0.5, 0.02], atol=1e-7)
    assert same_poses(robot, robot.held)
    assert robot.mj_model.neq == (coupling is LOOP)


def test_what_is_held_takes_what_follows_it_along(tmp_path):
    path = written(tmp_path)
    robot = load_robot(path, joints=["turn", "slip"], hold={"left": 0.01, "bend": -1.0})
    assert robot.held == pytest.approx({"bend": -1.0, "left": 0.01, "right": 0.01})
    assert robot.joint_names == ("turn", "slip")
    assert same_poses(robot, robot.held)
    # Another one before the one that is held, in the same body.
    robot = load_robot(path, joints=["turn", "bend"], hold={"slip": 0.05, "right": 0.04})
    assert robot.held == pytest.approx({"slip": 0.05, "left": 0.03, "right": 0.04})
    assert same_poses(robot, robot.held)


def test_a_circle_of_couplings_needs_a_value_unless_it_agrees(tmp_path):
    circle = (
        '<equality><joint joint1="right" joint2="left" polycoef="0.01 0.5 0 0 0"/>'
        '<joint joint1="left" joint2="right" polycoef="0.01 0.5 0 0 0"/></equality>'
    )
    path = written(tmp_path, circle)
    with pytest.raises(InputError, match=r"'right' of .* follows joints that follow it, and none"):
        load_robot(path)
    held = load_robot(path, hold={"left": 0.01}).held
    assert held == pytest.approx({"left": 0.01, "right": 0.015})
    same = written(tmp_path, circle.replace("0.01 0.5", "0 1"))
    assert load_robot(same).held == pytest.approx({"left": 0.03, "right": 0.03})


PULLED = TENDON.partition("<equality>")[0] + '<actuator><position tendon="grip"/></actuator>'


@pytest.mark.parametrize(
    ("coupling", "settings", "message"),
    [
        (
            TENDON,
            {"joints": ["turn", "left"]},
            "'left' of .* is coupled to 'right', which planning",
        ),
        (LOOP, {"joints": ["right"]}, "'right' of .* is coupled to 'left', which planning would"),
        (PULLED, {"joints": ["right"]}, "'right' of .* is coupled to 'left', which planning would"),
        (TENDON, {"joints": ["left", "right"]}, "'left' and 'right' of .* are tied by an equality"),
        (LOOP, {"joints": ["turn", "left", "right"]}, "tied by .*; plan for one of them at most"),
        (PULLED, {"joints": ["left", "right"]}, None),
        (TENDON, {"joints": ["left"], "hold": {"right": 0.01}}, None),
        (TENDON, {"hold": {"left": 0.01}}, "'left' of .* to be held and is tied to 'right', which"),
        (LOOP, {"hold": {"left": 0.01, "right": 0.01}}, None),
        (PULLED, {"hold": {"left": 0.01}}, None),
        (TENDON + EQUALITY, {"hold": {"left": 0.01}}, None),  # which says where the other one is
        (TENDON + EQUALITY, {"hold": {"right": 0.01}}, "'right' of .* tied to 'left', which would"),
    ],
)
def test_what_a_tendon_or_a_loop_moves_along_is_not_planned_for_where_it_was(
    tmp_path, coupling, settings, message
):
    path = written(tmp_path, coupling)
    if message is None:
        assert load_robot(path, **settings).num_dof == len(settings.get("joints", "tbs"))
        return
    with pytest.raises(InputError, match=message):
        load_robot(path, **settings)


def test_an_arm_that_a_hand_carries_by_a_weld_is_planned_for(tmp_path):
    path = tmp_path / "carried.xml"
    path.write_text(
        '<mujoco><worldbody><body name="target" mocap="true"/>'
        '<body name="link"><joint name="a" range="-90 90"/><geom size="0.1"/></body>'
        '</worldbody><equality><weld body1="target" body2="link"/></equality></mujoco>'
    )
    assert load_robot(path).joint_names == ("a",)
