"""What a viewer asks a planner, and what it tells of the answer."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.planning.planner import Planner
from gnnjax.planning.query import Plan, unit_of
from gnnjax.pose.goal import PoseGoal
from gnnjax.pose.inverse import inverse_kinematics
from gnnjax.pose.reasons import why_none
from gnnjax.scene.scene import Scene
from gnnjax.trajectory.options import MotionOptions, check_motion_options
from gnnjax.trajectory.states import sample_trajectory

_STEP_S = 0.02  # between states of a motion that are shown
_LIMITS = ("velocity", "acceleration", "torque", "jerk")


class Query(NamedTuple):
    """What is planned; told from another one by identity."""

    scene: Scene
    start: np.ndarray  # [D] rad or m
    goal: np.ndarray  # [D]


class Answer(NamedTuple):
    """What was found for a query."""

    query: Query
    plan: Plan | None  # None where the query is refused
    text: str  # about it, in Markdown
    path: np.ndarray  # [L D] configurations; L is 0 without a path
    times: np.ndarray  # [T] s, of what is played; T is 0 without a path
    positions: np.ndarray  # [T D]


Solve = Callable[[Query], Answer]
Reach = Callable[[Scene, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def make_solver(planner: Planner, options: MotionOptions, seed: int) -> Solve:
    """Makes what plans queries, and says of those that are refused why.

    Args:
        planner: of the arm.
        options: of the motion along a path. Of an arm whose model has no limits, and without limits
            in them, paths are shown at one radian, or metre, a second, which the text says.
        seed: of the roadmaps.

    Raises:
        InputError: see `check_motion_options`.
    """
    robot, missing = planner.robot, ""
    try:
        check_motion_options(robot, options)
    except InputError as error:
        if any(getattr(options, name) is not None for name in _LIMITS):
            raise
        missing = str(error)

    def solve(query: Query) -> Answer:
        try:
            plan = planner.plan(*query, seed=seed, trajectory=False if missing else options)
        except InputError as error:
            return without_path(query, None, str(error))
        if not plan.success:
            return without_path(query, plan, plan.reason)
        motion = plan.trajectory
        untimed = missing if motion is None else motion.reason
        if motion is None or not motion.success:
            steps = np.linalg.norm(np.diff(plan.path, axis=0), axis=1)
            times, positions = np.append(0.0, np.cumsum(steps)), plan.path
        else:
            shown = sample_trajectory(robot, motion, _STEP_S)
            times, positions = shown.times, shown.positions
        return Answer(query, plan, _told(robot, plan, untimed), plan.path, times, positions)

    return solve


def make_reach(robot: Robot, goal: PoseGoal, margin: float) -> Reach:
    """Makes the function `(scene, near [D], position [3], quat [4]) -> q [D]`: the valid
    configuration nearest to another one that puts the hand there, m.

    It raises `InputError` where there is none, with what is in the way.

    Args:
        robot: the arm.
        goal: whose frame, free axes and tolerance count.
        margin: clearance from obstacles, m.
    """

    def reach(scene: Scene, near: np.ndarray, position: np.ndarray, quat: np.ndarray) -> np.ndarray:
        pose = goal._replace(position=position, quat=quat)
        found = inverse_kinematics(robot, pose, scene, near=near, margin=margin)
        if not found.valid.any():
            raise InputError(why_none(robot, pose, scene, found, margin))
        return found.q[found.valid][0]

    return reach


def state_at(answer: Answer, time: float) -> np.ndarray:
    """The configuration `[D]` of what is played at a time, s."""
    columns = [np.interp(time, answer.times, column) for column in answer.positions.T]
    return np.array(columns)


def without_path(query: Query, plan: Plan | None, reason: str) -> Answer:
    """The answer to a query for which there is no path."""
    none = np.zeros((0, len(query.start)))
    return Answer(query, plan, f"**no path**: {reason}", none, np.zeros(0), none)


def _told(robot: Robot, plan: Plan, untimed: str) -> str:
    unit = unit_of(robot)
    certified = "certified free" if plan.certified else "not certified"
    edges = "no" if plan.edge_checks is None else plan.edge_checks
    lines = [
        f"**path of {len(plan.path)} configurations**, {certified}",
        f"cost {plan.cost:.3f} {unit}",
        f"{edges} edge checks, {plan.configuration_checks} configuration checks "
        f"({plan.sampling_checks} for sampling)",
        f"{1e3 * plan.total_time_s:.1f} ms, of which {1e3 * plan.planning_time_s:.1f} ms planning; "
        f"{plan.roadmaps} roadmap{'s' if plan.roadmaps > 1 else ''}",
    ]
    motion = plan.trajectory
    if untimed:
        lines.append(f"no motion in time, the path is shown at 1 {unit} a second: {untimed}")
    elif motion is not None:
        free = "certified free" if motion.certified else "not certified"
        lines.append(f"motion of {motion.duration:.2f} s, {free}, {motion.stops} stops")
        if motion.clearance is not None:
            lines.append(f"keeps {1e3 * motion.clearance:.0f} mm from all obstacles, or more")
    return "\n\n".join(lines)
