"""MoveIt's requests: whose joints start and end where, and what is refused."""

import copy
import logging

import numpy as np
import pytest
import yaml

from gnnjax import load_robot
from gnnjax.errors import InputError
from gnnjax.problems import moveit
from gnnjax.problems.moveit_names import end_alike, prefix_of
from tests.moveit_messages import REQUEST, SCENE, problem_of, put


@pytest.fixture(autouse=True)
def notes_are_new():
    """Each is logged once a process."""
    moveit._note.cache_clear()


@pytest.fixture
def message():
    return yaml.safe_load(SCENE)


@pytest.fixture
def request_message():
    return yaml.safe_load(REQUEST)


def test_joints_are_in_the_robots_order_whatever_the_files(tmp_path, tiny_path, caplog):
    problem = problem_of(tmp_path, load_robot(tiny_path), REQUEST)
    np.testing.assert_allclose(problem.start, [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(problem.goal, [-0.1, -0.2, -0.3], rtol=1e-6)
    assert problem.scene.mask.sum() == 3
    assert problem.start.dtype == np.float32
    problem_of(tmp_path, load_robot(tiny_path), REQUEST)
    (record,) = caplog.records
    assert record.message == "requests have finger at 0.04, which tiny does not have as a joint"


def test_names_that_end_alike_are_the_same_joint(tmp_path, caplog):
    robot = load_robot("franka_panda")  # joint_1 to joint_7
    names = [f"panda_joint{i}" for i in range(1, 8)]
    fingers = ["panda_finger_joint1", "panda_finger_joint2"]  # held at 0.04
    start = {"name": [*names, *fingers], "position": [*(0.1 * i for i in range(7)), 0.04, 0.065]}
    goal = [{"joint_name": name, "position": 0.5 + i} for i, name in enumerate(names)]
    request = {
        "start_state": {"joint_state": start},
        "goal_constraints": [{"joint_constraints": goal[::-1]}],
    }
    problem = problem_of(tmp_path, robot, request)
    np.testing.assert_allclose(problem.start, 0.1 * np.arange(7), rtol=1e-6)
    np.testing.assert_allclose(problem.goal, 0.5 + np.arange(7))
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.message.startswith(
        "requests have panda_finger_joint2 at 0.065, which franka_panda holds at 0.04; load_robot("
    )


@pytest.mark.parametrize(
    ("joint", "other", "alike"),
    [
        ("joint_1", "panda_joint1", True),
        ("iiwa_joint_1", "joint_a1", False),
        ("left_joint1", "right_joint1", False),
        ("joint_1", "panda_joint11", False),
        ("", "a", False),
    ],
)
def test_which_names_end_alike(joint, other, alike):
    assert end_alike(joint, other) is alike
    assert end_alike(other, joint) is alike


def test_names_may_be_given(tmp_path, tiny_path, request_message):
    robot = load_robot(tiny_path)
    text = REQUEST.replace("joint_name: a", "joint_name: waist").replace("r, a", "r, waist")
    with pytest.raises(InputError, match=r"goal joints b, c, waist, none .* surely 'a' of tiny"):
        problem_of(tmp_path, robot, text)
    problem = problem_of(tmp_path, robot, text, names={"a": "waist"})
    np.testing.assert_allclose(problem.goal, [-0.1, -0.2, -0.3], rtol=1e-6)
    with pytest.raises(InputError, match=r"names has \['q'\], and the joints of tiny are"):
        problem_of(tmp_path, robot, text, names={"q": "waist"})
    with pytest.raises(InputError, match="none of them surely 'a'"):
        problem_of(tmp_path, robot, text, names={"a": "wrist"})
    with pytest.raises(InputError, match="none of them surely 'a'"):
        problem_of(tmp_path, robot, text, names={"a": "b"})


def test_joints_that_are_held_must_be_held_there(tmp_path, tiny_path, caplog, request_message):
    """The start is a matter for a note, a goal cannot be reached."""
    for held, value in ((-0.3, "0.3"), (0.3, None)):
        robot = load_robot(tiny_path, hold={"c": held})
        if value is None:
            said = r"wants c at -0.3 in .*tiny_chosen_\w+ holds at 0.3; load"
            with pytest.raises(InputError, match=said):
                problem_of(tmp_path, robot, request_message)
            continue
        caplog.clear()
        problem = problem_of(tmp_path, robot, request_message)
        np.testing.assert_allclose(problem.start, [0.1, 0.2], rtol=1e-6)
        np.testing.assert_allclose(problem.goal, [-0.1, -0.2], rtol=1e-6)
        expected = f"requests have c at {value}, which {robot.name} holds at -0.3; load_robot("
        assert [r.message for r in caplog.records if expected in r.message]
    goal = request_message["goal_constraints"][0]["joint_constraints"]
    goal.append({"joint_name": "wing", "position": 1.0})
    with pytest.raises(InputError, match="wants wing at 1 in its goal, which tiny does not have"):
        problem_of(tmp_path, load_robot(tiny_path), request_message)


GOAL = ("goal_constraints", 0)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (put("goal_constraints", []), "has 0 goals"),
        (put("goal_constraints", [{}, {}]), "has 2 goals in goal_constraints; give one"),
        (put(*GOAL, "position_constraints", [{}]), r"\['position_constraints'\] in its goal"),
        (put(*GOAL, "joint_constraints", 0, "position", float("inf")), "position in .* finite"),
        (put(*GOAL, "joint_constraints", 0, "tolerance_above", -1), "must not be negative"),
        (put(*GOAL, "joint_constraints", 0, "joint_name", "a"), "constrains a twice"),
        (
            put("path_constraints", {"joint_constraints": [{}]}),
            "has path_constraints; path constraints are not supp",
        ),
        (put("path_constraints", {"name": "x", "joint_constraints": []}), None),
        (put("start_state", "joint_state", dict.pop), "start_state of .* lacks a, b, c"),
        (put("start_state", "joint_state", "position", [1.0]), "has 1 positions for the joints"),
        (put("start_state", "joint_state", "name", ["a", "a", "b", "c"]), "4 positions for"),
        (
            put("start_state", "multi_dof_joint_state", "transforms", 0, "translation", [0, 0, 1]),
            r"has the robot at \[0.0, 0.0, 1.0\] .* place it once",
        ),
        (put("start_state", "multi_dof_joint_state", dict.pop), None),
        (put("goals", []), r"has \['goals'\], which is not known here"),
    ],
)
def test_requests_that_ask_for_something_else_are_refused(
    tmp_path, tiny_path, request_message, change, fault
):
    change(request_message)
    robot = load_robot(tiny_path)
    if fault is None:
        assert problem_of(tmp_path, robot, request_message).start.shape == (3,)
        return
    with pytest.raises(InputError, match=fault):
        problem_of(tmp_path, robot, request_message)


def test_a_base_that_only_the_request_places_counts(tmp_path, tiny_path, message, request_message):
    robot = load_robot(tiny_path)
    here = problem_of(tmp_path, robot, request_message, message).scene
    del message["robot_state"]
    placed = copy.deepcopy(request_message)
    place = placed["start_state"]["multi_dof_joint_state"]["transforms"][0]
    place["translation"] = [0, 0, 1]
    there = problem_of(tmp_path, robot, placed, message).scene
    np.testing.assert_allclose(there.centers[:3], here.centers[:3] - [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("own", "other", "prefix"),
    [
        ("link_7", "panda_link7", ("panda", "")),
        ("my_arm_hand", "Hand", ("", "myarm")),
        ("left_hand", "lefthand", ("", "")),
        ("hand", "forehand", None),
        ("hand", "hand_left", None),
        ("", "hand", None),
    ],
)
def test_what_stands_before_names(own, other, prefix):
    assert prefix_of(own, other) == prefix
    assert prefix_of(other, own) == (prefix and prefix[::-1])
