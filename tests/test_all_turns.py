"""Configurations whole turns apart."""

import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.arm.turns import in_all_turns
from gnnjax.errors import InputError
from gnnjax.planning.load import load_planner
from gnnjax.scene.scene import make_scene


@pytest.fixture(scope="module")
def wide(tiny_path, tmp_path_factory):
    """Two of its joints turn twice."""
    text = tiny_path.read_text()
    for before in ("-3 3", "-2 2"):
        text = text.replace(f'range="{before}"', 'range="-6.2832 6.2832"')
    path = tmp_path_factory.mktemp("wide") / "tiny.xml"
    path.write_text(text)
    return load_robot(path)


def places(robot, q):
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    return np.concatenate([data.geom_xpos, data.geom_xmat], axis=1)


def test_links_are_in_the_same_places_in_all_turns(wide):
    q = np.float32([2.0, 0.5, -1.0])
    found = in_all_turns(wide, q)
    np.testing.assert_array_equal(found[0], q)
    turn = 2 * np.pi
    expected = [q, [2 - turn, 0.5, -1], [2, 0.5, turn - 1], [2 - turn, 0.5, turn - 1]]
    np.testing.assert_allclose(sorted(found.tolist()), sorted(map(list, expected)), atol=1e-6)
    for other in found:
        np.testing.assert_allclose(places(wide, other), places(wide, q), atol=1e-5)
    # At the limits' very middle, both ways.
    assert len(in_all_turns(wide, [0.0, 0.0, 0.0])) == 9


def test_an_arm_that_turns_once_has_one(tiny):
    np.testing.assert_array_equal(
        in_all_turns(tiny, [2.9, 0.5, -1.0]), [np.float32([2.9, 0.5, -1])]
    )


@pytest.mark.parametrize("q", [[0.0, 0.0], "home", [[0.0] * 3]])
def test_what_is_no_configuration_is_refused(wide, q):
    with pytest.raises(InputError, match="needs 3 joint values within its limits"):
        in_all_turns(wide, q)


@pytest.mark.parametrize("value", [7.0, np.nan])
def test_a_joint_beyond_its_limits_is_named(wide, value):
    with pytest.raises(InputError, match=f"has {value:g} for joint c; it must lie between -6.283"):
        in_all_turns(wide, [0.0, 0.0, value])


def test_the_command_goes_to_the_goal_in_any_turn(wide, tmp_path, run_as_command):
    scene = tmp_path / "scene.json"
    scene.write_text('{"boxes": [{"center": [0, 0, 0.9], "half_extents": [0.05, 0.05, 0.05]}]}')
    words = ["--robot", wide.path, "--scene", scene, "--start", 3, 0, 0, "--any-turn"]
    words += ["--out", tmp_path / "path.npz"]
    status, printed, _ = run_as_command("gnnjax.plan", *words, "--goal", -3, 0, 0)
    assert status in (0, None)
    assert "cost 0.283 rad" in printed
    pose = ["--goal-pose", 0.5, 0, 0.3, 1, 0, 0, 0]
    status, _, said = run_as_command("gnnjax.plan", *words, *pose)
    assert status == 2
    assert "--any-turn is of a --goal" in said


def test_a_goal_in_any_turn_may_be_nearer(wide):
    planner = load_planner(wide)
    start, goal = np.float32([3.0, 0.0, 0.0]), np.float32([-3.0, 0.0, 0.0])
    scene = make_scene([[0.0, 0.0, 0.9]], [[0.05, 0.05, 0.05]])
    there = planner.plan(scene, start, goal)
    nearer = planner.plan(scene, start, goals=in_all_turns(wide, goal))
    assert there.cost == pytest.approx(6.0)
    assert nearer.cost == pytest.approx(2 * np.pi - 6.0, abs=1e-5)
