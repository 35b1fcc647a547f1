"""MoveIt's motion plan requests, written as YAML: a start and a goal in a planning scene."""

import functools
import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief
from gnnjax.problems.moveit_names import (
    Prefix,
    body_of,
    end_alike,
    listed,
    matched_joints,
    prefixes_of_all,
    prefixes_of_links,
)
from gnnjax.problems.problem import Problem
from gnnjax.scene.holding import attach
from gnnjax.scene.messages import fields_of, list_of, numbers, read_message
from gnnjax.scene.moveit import (
    JOINT_STATE,
    Attached,
    PlanningScene,
    RobotState,
    read_planning_scene,
    refuse_attached,
    scene_of,
    state_of,
)
from gnnjax.scene.pose import IDENTITY
from gnnjax.scene.scene import Scene

_LOG = logging.getLogger(__name__)

# Of a request, what says which problem it is, and what says how to plan.
_PROBLEM = ["start_state", "goal_constraints"]
_HOW = (
    "workspace_parameters reference_trajectories pipeline_id planner_id group_name "
    "num_planning_attempts allowed_planning_time max_velocity_scaling_factor "
    "max_acceleration_scaling_factor cartesian_speed_end_effector_link "
    "cartesian_speed_limited_link max_cartesian_speed"
).split()
_CONSTRAINTS = (
    "name joint_constraints position_constraints orientation_constraints visibility_constraints"
).split()
_ON_THE_WAY = {"path_constraints": _CONSTRAINTS, "trajectory_constraints": ["constraints"]}
_JOINT_CONSTRAINT = "joint_name position tolerance_above tolerance_below weight".split()
_SAME = 1e-6  # m or rad, up to which two files agree


def problem_from_moveit(
    scene_path: str | Path,
    request_path: str | Path,
    robot: Robot,
    *,
    names: Mapping[str, str] | None = None,
) -> Problem:
    """Reads a problem from a planning scene and a motion plan request of MoveIt, both YAML.

    The start is the request's start state, and the goal the middle of its joint constraints, the
    tolerances of which hold for any path that ends there. Joints are matched by name, or else where
    names end alike but for punctuation: `joint_1` is `panda_joint1`. Joints that the robot does not
    plan for are held by its model; where the request has them elsewhere, a line is logged.

    Args:
        scene_path: see `scene_from_moveit`.
        request_path: moveit_msgs/MotionPlanRequest.
        robot: the arm.
        names: the request's name of each of the robot's joints, where neither rule finds it.

    Raises:
        InputError: a file that cannot be read, a goal that is no configuration, constraints on the
            way, a joint that is missing, a base that stands elsewhere than in the scene, or objects
            that are attached to the robot, for which there is `query_from_moveit`.
    """
    found, state, problem, _ = _read(scene_path, request_path, robot, names or {})
    refuse_attached(found.state, f"planning scene {str(scene_path)!r}")
    refuse_attached(state, f"request {str(request_path)!r}")
    return problem


class MoveItQuery(NamedTuple):
    """What is to be planned, and for which arm."""

    robot: Robot
    problem: Problem


def query_from_moveit(
    scene_path: str | Path,
    request_path: str | Path,
    robot: Robot,
    *,
    names: Mapping[str, str] | None = None,
) -> MoveItQuery:
    """`problem_from_moveit` with the arm that holds what is attached to the robot.

    That is `robot` itself where nothing is. Objects may be attached in the scene or in the start
    state of the request. They are held by the bodies that are called like their links, and may
    touch those of their `touch_links`; MoveIt's frames of these links must be the arm's, too.

    Links are called like bodies where they are but for punctuation, and for the prefix that all
    joints of the request have beside the arm's, or else one that all joints have: with
    `panda_joint1` for `joint_1`, `panda_link7` is `link_7`, and `left_hand` is not `hand`; `names`
    may say that it is. A line is logged of each that is called otherwise, and of each that is no
    body of the arm: what is held stays clear of all that is not named.

    Args:
        scene_path: see `scene_from_moveit`.
        request_path: moveit_msgs/MotionPlanRequest.
        robot: the arm.
        names: the files' name of each of the robot's joints or bodies, where no rule finds it.

    Raises:
        InputError: see there and `Robot.attach`; or a link that the arm does not have.
    """
    names = names or {}
    found, state, problem, prefixes = _read(scene_path, request_path, robot, names)
    if found.state.attached and state.attached:
        raise InputError(
            f"request {str(request_path)!r} and planning scene {str(scene_path)!r} both have "
            "objects attached to the robot; keep those of one"
        )
    attached = [*found.state.attached, *state.attached]
    return MoveItQuery(_holding(robot, attached, prefixes, names), problem)


def surroundings_from_moveit(scene_path: str | Path, robot: Robot) -> tuple[Robot, Scene]:
    """The arm, with what a planning scene has attached to it, and the scene as its base sees it.

    Links are called like bodies as in `query_from_moveit`, where all joints of the scene's robot
    state have the prefix.

    Raises:
        InputError: see there, and `scene_from_moveit`.
    """
    found = read_planning_scene(scene_path)
    prefixes = prefixes_of_all(robot.joint_names, found.state.joints)
    robot = _holding(robot, found.state.attached, prefixes, {})
    return robot, scene_of(found, f"planning scene {str(scene_path)!r}")


def _holding(
    robot: Robot,
    attached: list[Attached],
    prefixes: Collection[Prefix],
    names: Mapping[str, str],
) -> Robot:
    """The arm that holds what is attached to it."""
    arm = robot  # bodies of what it holds are no links
    for thing in attached:
        body = body_of(arm, thing.link, prefixes, names)
        if body is None:
            known = [x.name for x in arm.bodies if x.name]
            like = body_of(arm, thing.link, None, names) or known[-1]
            raise InputError(
                f"{thing.source}: {arm.name} has no such body, but {brief(known)}; call it like "
                f"one of these, or say names={{{like!r}: {thing.link!r}}}"
            )
        links = {name: body_of(arm, name, prefixes, names) for name in thing.touches}
        for name, own in {thing.link: body, **links}.items():
            if own is None:
                _note(f"planning scenes let {name} be touched, which {arm.name} does not have")
            elif own != name:
                _note(f"link {name} of planning scenes is taken for body {own} of {arm.name}")
        touched = [own for own in links.values() if own is not None]
        robot = attach(robot, body, thing.shapes, mass=thing.mass, allow=touched)
    return robot


def _read(
    scene_path: str | Path, request_path: str | Path, robot: Robot, names: Mapping[str, str]
) -> tuple[PlanningScene, RobotState, Problem, set[Prefix]]:
    """The scene, the state that the request starts from, the problem of both, and what may stand
    before names of links."""
    called = f"request {str(request_path)!r}"
    message = read_message(request_path, "request", [*_PROBLEM, *_ON_THE_WAY, *_HOW])
    for name, known in _ON_THE_WAY.items():
        constraints = fields_of(message.get(name), known, f"{name} of {called}")
        if any(value for key, value in constraints.items() if key != "name"):
            raise InputError(
                f"{called} has {name}; path constraints are not supported; remove them to plan "
                "without"
            )
    found = read_planning_scene(scene_path)
    state = state_of(message.get("start_state"), {"": IDENTITY}, called)
    base, other = state.base, found.state.base
    if base is not None and other is not None:
        apart = np.abs(base.position - other.position).max()
        turned = 1 - abs(base.quat @ other.quat)
        if max(apart, turned) > _SAME:
            raise InputError(
                f"{called} has the robot at {base.position.tolist()} (w x y z "
                f"{base.quat.tolist()}), its scene at {other.position.tolist()} "
                f"({other.quat.tolist()}); place it once"
            )
    goal = _goal(message, called)
    start = _start(message, called)
    mapping = matched_joints(robot, list(goal), names, called)
    for name in goal.keys() - set(mapping.values()):
        held = _held(robot, name)
        if held is None or abs(held - goal[name]) > _SAME:
            at = "does not have" if held is None else f"holds at {held:g}"
            raise InputError(
                f"{called} wants {name} at {goal[name]:g} in its goal, which {robot.name} {at}; "
                "load the robot with that joint, or remove the constraint"
            )
    _note_others(robot, start, set(mapping.values()))
    placed = found._replace(state=found.state._replace(base=other or base))
    problem = Problem(
        _configuration(mapping, start, f"start_state of {called}"),
        _configuration(mapping, goal, f"goal of {called}"),
        scene_of(placed, f"planning scene {str(scene_path)!r}"),
    )
    return found, state, problem, prefixes_of_links(mapping)


def _start(message: dict[str, Any], called: str) -> dict[str, float]:
    """Positions of the start state's joints by name."""
    state = message.get("start_state") or {}  # its fields are known since `state_of`
    joints = fields_of(state.get("joint_state"), JOINT_STATE, f"joint_state of {called}")
    given = list_of(joints, "name", called)
    values = numbers(joints.get("position") or [], None, f"position of joint_state of {called}")
    if len(given) != len(values) or len(set(map(str, given))) < len(given):
        raise InputError(
            f"{called} has {len(values)} positions for the joints {brief(given)}; give each one"
        )
    return dict(zip(map(str, given), values.tolist(), strict=True))


def _goal(message: dict[str, Any], called: str) -> dict[str, float]:
    """Positions that the goal's joint constraints ask for, by name."""
    goals = list_of(message, "goal_constraints", called)
    if len(goals) != 1:
        raise InputError(f"{called} has {len(goals)} goals in goal_constraints; give one")
    fields = fields_of(goals[0], _CONSTRAINTS, f"goal_constraints of {called}")
    other = [name for name in _CONSTRAINTS[2:] if fields.get(name)]
    if other:
        raise InputError(
            f"{called} has {other} in its goal; goals are configurations, so give joint_constraints"
        )
    found: dict[str, float] = {}
    for value in list_of(fields, "joint_constraints", called):
        inside = f"a joint constraint of {called}"
        constraint = fields_of(value, _JOINT_CONSTRAINT, inside)
        name = str(constraint.get("joint_name"))
        inside = f"the constraint of {name} of {called}"
        (position,) = numbers([constraint.get("position")], 1, f"position in {inside}")
        for side in ("tolerance_above", "tolerance_below"):
            (tolerance,) = numbers([constraint.get(side, 0)], 1, f"{side} in {inside}")
            if tolerance < 0:
                raise InputError(f"{side} in {inside} is {tolerance}; it must not be negative")
        if name in found:
            raise InputError(f"{called} constrains {name} twice; give one goal")
        found[name] = float(position)
    return found


def _note_others(robot: Robot, start: dict[str, float], planned: set[str]) -> None:
    """Notes where joints are that the robot does not plan for, unless it holds them there."""
    for name, value in start.items():
        held = _held(robot, name)
        if name in planned or (held is not None and abs(held - value) <= _SAME):
            continue
        where = "does not have as a joint"
        if held is not None:
            where = f"holds at {held:g}; load_robot(hold=...), or --hold, can have it there, too"
        _note(f"requests have {name} at {value:g}, which {robot.name} {where}")


def _held(robot: Robot, name: str) -> float | None:
    """Where the robot holds a joint of the request, rad or m; none that it does not hold."""
    alike = [own for own in robot.held if end_alike(own, name)]
    own = name if name in robot.held or len(alike) != 1 else alike[0]
    return robot.held.get(own)


@functools.cache
def _note(text: str) -> None:
    """Logs a line, once for all the requests of a set."""
    _LOG.warning(text)


def _configuration(mapping: dict[str, str], values: dict[str, float], called: str) -> np.ndarray:
    missing = [name for name in mapping.values() if name not in values]
    if missing:
        raise InputError(f"{called} lacks {listed(missing)}; give all joints")
    return np.array([values[name] for name in mapping.values()], np.float32)
