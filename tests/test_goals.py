"""Queries with several goals, and with a pose for a goal."""

import logging
import re
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_path
from gnnjax.errors import InputError
from gnnjax.plan import PlanConfig
from gnnjax.plan import main as plan_once
from gnnjax.planning.goals import plan_to_cheapest
from gnnjax.planning.load import load_planner, make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.progress import Limits
from gnnjax.planning.query import make_plan, path_length
from gnnjax.pose.goal import PoseGoal
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import make_scene
from tests.fine_scan import random_scene

TURNS = ("rx", "ry", "rz")
PLACES = ("x", "y", "z")
START = [-1.5, 0.0, 0.0]
BOX = {"centers": [[0.6, 0.0, 0.0]], "half_extents": [[0.1, 0.1, 0.1]]}


@pytest.fixture(scope="module")
def planner(tiny_path):
    return load_planner(tiny_path, "lazysp", num_nodes=60, max_roadmaps=2)


def place(robot, q):
    """Where MuJoCo has the last body."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    return data.xpos[-1].copy()


def attempts(costs):
    """Plans to goals on a line at the distances that `costs` names, at what they cost after a hasty
    look and after all; and what was asked."""
    asked = []

    def attempt(goal, limits):
        asked.append((float(goal[0]), limits))
        cost = costs[float(goal[0])][not limits.is_hasty]
        path = None if cost is None else np.array([[0.0], [cost]])
        counts = {"edge_checks": 1, "sampling_checks": 2, "search_checks": 3, "roadmaps": 4}
        return make_plan(path, "no way", 1, **counts, planning_time_s=0.5, total_time_s=1.0)

    return attempt, asked


@pytest.mark.parametrize(
    ("costs", "best", "asked"),
    [
        # A straight line: none of the others can cost less.
        ({1.0: (1.0, 1.0), 2.0: (2.0, 2.0)}, 1.0, [(1, True)]),
        # Until those that are left are farther away than the way that was found.
        ({1.0: (5.0, 5.0), 2.0: (3.0, 3.0), 4.0: (4.0, 4.0)}, 3.0, [(1, True), (2, True)]),
        ({1.0: (None, 1.0), 2.0: (3.0, 3.0)}, 3.0, [(1, True), (2, True)]),
        # Nothing in haste: the first that is found with all.
        (
            {1.0: (None, None), 2.0: (None, 7.0), 3.0: (None, 3.0)},
            7.0,
            [(1, True), (2, True), (3, True), (1, False), (2, False)],
        ),
        ({1.0: (None, 9.0)}, 9.0, [(1, False)]),
    ],
)
def test_the_cheapest_goal_is_taken_and_all_that_was_tried_is_counted(costs, best, asked):
    attempt, seen = attempts(costs)
    plan = plan_to_cheapest(attempt, np.zeros(1), np.array(list(costs))[:, None], np.inf)
    assert plan.cost == best
    assert [(goal, limits.is_hasty) for goal, limits in seen] == asked
    counts = plan.edge_checks, plan.sampling_checks, plan.search_checks, plan.roadmaps
    assert counts == tuple(x * len(asked) for x in (1, 2, 3, 4))
    assert plan.configuration_checks == 5 * len(asked)
    assert (plan.planning_time_s, plan.total_time_s) == (0.5 * len(asked), len(asked))


def test_no_further_goal_is_tried_when_time_is_over():
    attempt, asked = attempts({1.0: (None, None), 2.0: (None, None), 3.0: (None, None)})
    goals = np.array([[1.0], [2.0], [3.0]])
    plan = plan_to_cheapest(attempt, np.zeros(1), goals, 1.5)
    assert not plan.success
    assert plan.reason == "no path to 2 of 3 goals in 1.5 s; give it more time"
    # Each has what the others have left.
    assert [limits.time for _, limits in asked] == [1.5, 0.5]
    plan = plan_to_cheapest(attempt, np.zeros(1), goals, 9.0)
    assert plan.reason == "no path to any of 3 goals; the last one: no way"


@pytest.mark.parametrize("check_cost", [1.0, 1000.0])
def test_a_hasty_look_ends_soon(tiny, check_cost):
    planner = make_planner(tiny, PlannerOptions(num_nodes=32, check_cost=check_cost))
    wall = make_scene([[0.6, 0.0, 0.0]], [[0.5, 0.02, 0.9]])  # from the base to beyond its reach
    scenes = jax.tree.map(lambda x: np.asarray(x)[None], wall)
    rows = np.array([START], np.float32), np.array([[1.5, 0.0, 0.0]], np.float32)
    (plan,) = planner._plan_batch(Problem(*rows, scenes), 0, Limits(is_hasty=True))
    assert not plan.success
    assert plan.roadmaps == 1
    most = {1.0: r"no path in (\d|1[0-6]) rounds", 1000.0: "no path in the 1 roadmaps tried"}
    assert re.match(most[check_cost], plan.reason)


def test_of_several_goals_the_cheapest_is_planned_to(planner):
    robot, scene = planner.robot, random_scene(np.random.default_rng(4))
    rng = np.random.default_rng(0)
    start, *goals = rng.uniform(robot.joint_lower, robot.joint_upper, (6, 3)).astype(np.float32)
    single = [planner.plan(scene, start, goal) for goal in goals]
    assert all(plan.success for plan in single)
    cheapest = min(single, key=lambda plan: plan.cost)
    plan = planner.plan(scene, start, goals=goals)
    assert plan.certified
    np.testing.assert_array_equal(plan.path, cheapest.path)
    assert plan.edge_checks > cheapest.edge_checks
    again = planner.plan(scene, start, goals=8 * [goals[1]] + goals[::-1])
    np.testing.assert_array_equal(plan.path, again.path)


def test_goals_in_collision_are_left_out_and_named(planner, caplog):
    scene, blocked = make_scene(**BOX), [0.0, 0.0, 0.0]
    with caplog.at_level(logging.WARNING):
        plan = planner.plan(scene, START, goals=[blocked, [1.5, 0.0, 0.0]])
    np.testing.assert_allclose(plan.path[-1], [1.5, 0.0, 0.0])
    assert "1 of 2 goals are left out: goal [0.0, 0.0, 0.0] is in collision: " in caplog.text
    with pytest.raises(InputError, match=r"none of 2 goals can be planned to: goal .* collision"):
        planner.plan(scene, START, goals=[blocked, blocked])


def test_a_plan_to_a_pose_ends_in_it(planner):
    robot, scene = planner.robot, make_scene(**BOX)
    where = place(robot, [1.2, -0.6, 0.4])
    pose = PoseGoal(where, [1.0, 0, 0, 0], free=TURNS)
    plan = planner.plan(scene, START, goal_pose=pose)
    assert plan.certified
    assert certify_path(robot, scene, plan.path)
    assert np.linalg.norm(place(robot, plan.path[-1]) - where) < 1.1e-4
    np.testing.assert_allclose(plan.path[0], START)
    again = planner.plan(scene, START, goal_pose=pose)
    np.testing.assert_array_equal(plan.path, again.path)


def test_what_stands_in_the_way_of_a_pose_is_named(planner):
    robot, free = planner.robot, make_scene([], [])
    with pytest.raises(
        InputError,
        match=r"lower of tiny does not reach the pose: at the nearest it is \d+\.\d mm and "
        r"0\.000 rad away, with (no joint|b) at (a|its) limit.*; choose a pose within reach",
    ):
        planner.plan(free, START, goal_pose=PoseGoal([2.0, 0, 0], [1.0, 0, 0, 0], free=TURNS))
    where = place(robot, [1.0, 0.5, 0.0])
    with pytest.raises(InputError, match=r"if it may turn freely, it comes to 0\.0 mm"):
        planner.plan(free, START, goal_pose=PoseGoal(where, [0.0, 1.0, 0, 0]))
    # A turn alone: nothing is left of it where it may turn freely.
    for axes in (PLACES, (*PLACES, "rz")):
        with pytest.raises(InputError, match=r"does not reach .* limit( of \S+)?; choose a pose"):
            planner.plan(free, START, goal_pose=PoseGoal(where, [0.0, 0, 1.0, 0], free=axes))
    pose = PoseGoal(place(robot, [0.0, 0.0, 0.0]), [1.0, 0, 0, 0], free=TURNS)
    with pytest.raises(
        InputError,
        match=r"lower of tiny reaches the pose in \d configurations found, and all collide: .* "
        r"with box 0 in \d; move the pose",
    ):
        planner.plan(make_scene(**BOX), START, goal_pose=pose)


def test_a_margin_is_kept_at_the_pose(tiny_path):
    careful = load_planner(tiny_path, "lazysp", num_nodes=60, max_roadmaps=2, margin=0.5)
    pose = PoseGoal(place(careful.robot, [0.8, 0.0, 0.0]), [1.0, 0, 0, 0], free=TURNS)
    with pytest.raises(InputError, match="comes within 500 mm of an obstacle in"):
        careful.plan(make_scene(**BOX), [-2.9, 0.0, 0.0], goal_pose=pose)


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ({}, "a query needs just one of goal, goals and goal_pose"),
        ({"goal": [0.0] * 3, "goals": [[0.0] * 3]}, "just one of goal, goals and goal_pose"),
        ({"goals": []}, "goals are .*; tiny needs a list of one or more, with 3 joint values each"),
        ({"goals": [0.0, 1.0, 0.0]}, "goals are .*; tiny needs a list"),
        ({"goals": [[10**400, 0, 0]]}, "goals are .*; tiny needs a list"),
        ({"goal": [10**400, 0, 0]}, "goal .* is not a list of numbers"),
        ({"goals": [["a", 0, 0]]}, "goals are .*; tiny needs a list"),
        ({"goals": [[9.0, 0, 0]]}, "none of 1 goals can be planned to: goal has 9 for joint a"),
        (
            {"goal_pose": PoseGoal([[0.5, 0, 0]] * 2, [[1.0, 0, 0, 0]] * 2)},
            "the pose has the position .*; plan to one pose",
        ),
        ({"goal_pose": PoseGoal([0.5, 0, 0], [1, 0, 0, 0], free=None)}, "has free axes None; give"),  # pyright: ignore[reportArgumentType]
        (
            {"goal_pose": PoseGoal([0.5, 0, 0], [1, 0, 0, 0], tolerance="a")},
            "tolerance is .*; give",
        ),  # pyright: ignore[reportArgumentType]
    ],
)
def test_bad_goals_are_refused(planner, ends, message):
    with pytest.raises(InputError, match=message):
        planner.plan(make_scene(**BOX), START, **ends)


def test_what_is_missing_to_the_least_tolerance_is_not_said_to_be_nothing(planner):
    pose = PoseGoal(place(planner.robot, [0.8, 0.3, 0.2]), [1.0, 0, 0, 0], free=TURNS)
    with pytest.raises(InputError, match=r"at the nearest it is \d\S*e-\d+ mm"):
        planner.plan(make_scene(**BOX), START, goal_pose=pose._replace(tolerance=(1e-12, 1.0)))


def test_a_bad_start_is_named_before_the_goals(planner):
    with pytest.raises(InputError, match="start has 9 for joint a"):
        planner.plan(make_scene(**BOX), [9.0, 0, 0], goals=[[9.0, 0, 0]])


@pytest.fixture
def command(tiny_path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.json").write_text('{"boxes": []}')

    def run(**options):
        own = {"scene": Path("scene.json"), "robot": str(tiny_path), "start": tuple(START)}
        own |= {"planner": "lazysp", "num_nodes": 60, "max_roadmaps": 2}
        return plan_once(PlanConfig(**(own | options)))

    return run


def test_the_command_plans_to_a_pose(command, tiny_path):
    robot = load_robot(tiny_path)
    where = place(robot, [1.2, -0.6, 0.4])
    pose = (*where.tolist(), 1.0, 0.0, 0.0, 0.0)
    assert command(goal_pose=pose, free=TURNS, tolerance=(1e-3, 1e-3), frame="lower") == 0
    path = np.load("path.npz")["path"]
    assert np.linalg.norm(place(robot, path[-1]) - where) < 1.1e-3
    assert path_length(path) > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"goal_pose": (0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), "goal": (0.0, 0.0, 0.0)},
            "a query has --goal and --goal-pose; give one of them",
        ),
        ({"goal": (0.0, 0.0, 0.0), "free": ("rz",)}, "--free and --tolerance are of a --goal-pose"),
        ({"goal_pose": (0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)}, "the pose has the quaternion"),
        (
            {"goal_pose": (0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), "frame": "hook"},
            "no site or body 'hook'",
        ),
    ],
)
def test_the_command_refuses_bad_poses_before_planning(command, options, message):
    with pytest.raises(InputError, match=message):
        command(**options)
