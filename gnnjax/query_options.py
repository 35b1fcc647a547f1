"""What a query is on a command line, once: for the commands that plan one."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm_options import HoldingOptions
from gnnjax.errors import InputError
from gnnjax.pose.goal import PoseGoal, check_goal, tool_frame
from gnnjax.problems.moveit import query_from_moveit, surroundings_from_moveit
from gnnjax.problems.problem import Problem
from gnnjax.scene.any_file import is_moveit, read_scene
from gnnjax.scene.scene import Scene, make_scene


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """What stands around an arm."""

    scene: Path
    """File of the obstacles: .json (lists of them), .yaml (a planning scene of MoveIt), .xml (a
    MuJoCo model, less the robot in it), .bt or .ot (an octomap)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class QueryOptions(SceneOptions, HoldingOptions):
    """An arm, what stands around it, and where it is to go from where."""

    start: tuple[float, ...] | None = None
    """Joint values, rad (m for slides), in the order that `gnnjax.fit` prints."""
    goal: tuple[float, ...] | None = None
    """Joint values, rad (m for slides), in the order that `gnnjax.fit` prints."""
    goal_pose: tuple[float, float, float, float, float, float, float] | None = None
    """Instead of a goal: where a frame of the arm should be, x y z (m) and a quaternion w x y z,
    in the frame of the arm's base."""
    frame: str | None = None
    """Site or body that should be at the goal pose; by default the site "tool", or else the last
    body."""
    free: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    """Axes of the goal pose along which the position is free (x y z), and about which the rotation
    is free (rx ry rz; one of these, or all)."""
    tolerance: tuple[float, float] = (1e-4, 1e-3)
    """How near to the goal pose is near enough, m and rad."""
    request: Path | None = None
    """MoveIt's motion plan request (.yaml), in place of start and goal."""
    seed: int = 0
    """Seed of roadmaps and trees."""


def read_query(
    options: QueryOptions, robot: Robot, *, edited: bool = False
) -> tuple[Robot, np.ndarray, dict[str, Any], Scene]:
    """Start, goal and scene that files and options say; the goal as an argument of a planner's. And
    the arm, which holds what a request or scene of MoveIt has attached to it.

    Args:
        options: of the command.
        robot: the arm.
        edited: it is changed later on. So a start or goal that is not given is the arm's home,
            and without a file the scene is empty, where else they are asked for.
    """
    given, goal = options.start, options.goal
    if not edited and options.goal_pose is None and of_pose(options) != of_pose(QueryOptions):
        raise InputError("--frame, --free and --tolerance are of a --goal-pose; give one, too")
    if options.request is None:
        if edited:
            given = tuple(robot.home.tolist()) if given is None else given
            goal = tuple(robot.home.tolist()) if not _ends(options) else goal
        if goal is not None and options.goal_pose is not None:
            raise InputError("a query has --goal and --goal-pose; give one of them")
        if given is None or (goal is None) == (options.goal_pose is None):
            raise InputError(
                "a query needs --start and --goal, or a --request of MoveIt's; --goal-pose may "
                "take the place of --goal"
            )
        scene = make_scene([], [])
        if not edited or options.scene is not None:
            robot, scene = read_surroundings(options.scene, robot)
        start = np.array(given)
        if options.goal_pose is None:
            return robot, start, {"goal": np.array(goal)}, scene
        place, quat = options.goal_pose[:3], options.goal_pose[3:]
        pose = PoseGoal(place, quat, *of_pose(options))
        check_goal(pose)
        tool_frame(robot, pose.frame)
        return robot, start, {"goal_pose": pose}, scene
    if given is not None or _ends(options):
        raise InputError("--request has a start and a goal; leave --start and --goal out")
    robot, (start, goal, scene) = read_request(options.scene, options.request, robot)
    return robot, np.asarray(start), {"goal": goal}, scene


def read_surroundings(scene: Path, robot: Robot) -> tuple[Robot, Scene]:
    """The scene of a file, and the arm, which holds what a planning scene of MoveIt has attached to
    it."""
    if is_moveit(scene):
        return surroundings_from_moveit(scene, robot)
    return robot, read_scene(scene, robot)


def read_request(scene: Path | None, request: Path, robot: Robot) -> tuple[Robot, Problem]:
    """`query_from_moveit` of a scene that a command was given."""
    if scene is None or not is_moveit(scene):
        named = "missing" if scene is None else repr(str(scene))
        raise InputError(f"--request needs a planning scene of MoveIt (.yaml); --scene is {named}")
    return query_from_moveit(scene, request, robot)


def of_pose(options: Any) -> tuple[Any, Any, Any]:
    """Free axes, tolerance and frame, as they stand in a `PoseGoal`."""
    return options.free, options.tolerance, options.frame


def _ends(options: QueryOptions) -> bool:
    return options.goal is not None or options.goal_pose is not None
