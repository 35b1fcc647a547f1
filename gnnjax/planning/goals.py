"""Queries with several goals: configurations of which any will do, or those that reach a pose."""

import logging
from collections.abc import Callable, Sequence

import jax
import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief
from gnnjax.planning.progress import Limits
from gnnjax.planning.query import Plan, check_queries, check_query
from gnnjax.pose.goal import PoseGoal
from gnnjax.pose.inverse import inverse_kinematics
from gnnjax.pose.reasons import why_none
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import Scene

_LOG = logging.getLogger(__name__)

MOST_GOALS = 8  # of a query, the nearest to the start


def find_goals(
    robot: Robot,
    scene: Scene,
    start: ArrayLike,
    goal: ArrayLike | None,
    goals: ArrayLike | None,
    pose: PoseGoal | None,
    margin: float,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """A query's start, and the goals `[G D]` that are to be tried, the nearest first.

    Args:
        robot: the arm.
        scene: one scene.
        start: configuration.
        goal: configuration, or
        goals: configurations, or
        pose: of a frame of the arm; the others are None.
        margin: clearance that all must have from obstacles, m.
        seed: of where configurations for the pose are looked for.

    Raises:
        InputError: not just one of the three, or a query that is none.
    """
    if sum(x is not None for x in (goal, goals, pose)) != 1:
        raise InputError("a query needs just one of goal, goals and goal_pose")
    if pose is not None:
        return _reaching(robot, scene, start, pose, margin, seed)
    if goals is not None:
        return _valid(robot, scene, start, goals, margin)
    assert goal is not None
    start, end = check_query(robot, scene, start, goal, margin)
    return start, end[None]


def _reaching(
    robot: Robot, scene: Scene, start: ArrayLike, pose: PoseGoal, margin: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """A query's start, and valid configurations `[G D]` that reach a pose, the nearest first.

    Raises:
        InputError: a bad start or scene, or a pose without a valid configuration.
    """
    start, _ = check_query(robot, scene, start, start, margin)
    if np.ndim(pose.position) != 1:
        raise InputError(f"the pose has the position {brief(pose.position)}; plan to one pose")
    found = inverse_kinematics(
        robot, pose, scene, near=start, num_solutions=MOST_GOALS, margin=margin, seed=seed
    )
    if not found.valid.any():
        raise InputError(why_none(robot, pose, scene, found, margin))
    return start, found.q[found.valid]


def _valid(
    robot: Robot, scene: Scene, start: ArrayLike, goals: ArrayLike, margin: float
) -> tuple[np.ndarray, np.ndarray]:
    """A query's start, and those of some goals `[G D]` that are valid, the nearest first; what is
    wrong with others is logged.

    Raises:
        InputError: a bad start or scene, or no valid goal.
    """
    start, _ = check_query(robot, scene, start, start, margin)
    try:
        with np.errstate(over="ignore"):  # infinite in single precision, and refused as such
            ends: np.ndarray = np.asarray(goals, np.float32)
    except (TypeError, ValueError, OverflowError):
        ends = np.zeros(0, np.float32)
    if ends.ndim != 2 or not len(ends) or ends.shape[1] != robot.num_dof:
        raise InputError(
            f"goals are {brief(goals)}; {robot.name} needs a list of one or more, with "
            f"{robot.num_dof} joint values each"
        )
    num = len(ends)
    one = jax.tree.map(lambda x: np.broadcast_to(x, (num, *np.shape(x))), (start, scene))
    reasons = check_queries(robot, Problem(one[0], ends, one[1]), margin)
    bad = [i for i, reason in enumerate(reasons) if reason is not None]
    if len(bad) == num:
        raise InputError(f"none of {num} goals can be planned to: {reasons[0]}")
    if bad:
        _LOG.warning("%d of %d goals are left out: %s", len(bad), num, reasons[bad[0]])
        ends = np.delete(ends, bad, axis=0)
    ends = np.unique(ends, axis=0)
    order = np.argsort(np.linalg.norm(ends - start, axis=1), kind="stable")
    return start, ends[order[:MOST_GOALS]]


def plan_to_cheapest(
    attempt: Callable[[np.ndarray, Limits], Plan],
    start: np.ndarray,
    goals: np.ndarray,
    time_limit: float,
) -> Plan:
    """Plans to whichever of some goals a path costs least to, as far as is tried.

    First with a hasty look at each goal, until none of those that are left can cost less than what
    was found; then, where nothing was found, with all that a planner tries, until something is.

    Args:
        attempt: plans to a goal `[D]` within limits.
        start: `[D]`.
        goals: `[G D]`, the nearest first.
        time_limit: s, for all goals together.

    Returns:
        The plan to that goal, with the checks, roadmaps and times of all that was tried.
    """
    if len(goals) == 1:
        return attempt(goals[0], Limits(time_limit))
    plans: list[Plan] = []
    best: Plan | None = None
    left, tried = time_limit, 0
    for is_hasty in (True, False):
        for number, goal in enumerate(goals, start=1):
            # No path is shorter than a straight line.
            through = best is not None and (
                not is_hasty or best.cost <= np.linalg.norm(goal - start)
            )
            if through or left < 0:
                break
            plans.append(attempt(goal, Limits(left, is_hasty)))
            left, tried = left - plans[-1].total_time_s, max(tried, number)
            if plans[-1].success and (best is None or plans[-1].cost < best.cost):
                best = plans[-1]
    if best is None:
        reason = f"no path to any of {len(goals)} goals; the last one: {plans[-1].reason}"
        if left < 0:
            reason = (
                f"no path to {tried} of {len(goals)} goals in {time_limit:g} s; give it more time"
            )
        best = plans[-1]._replace(reason=reason)
    return _summed(best, plans)


def _summed(best: Plan, plans: Sequence[Plan]) -> Plan:
    """A plan, at the cost of all."""
    names = "edge_checks configuration_checks sampling_checks search_checks".split()
    names += ["planning_time_s", "total_time_s", "roadmaps"]
    return best._replace(**{name: sum(getattr(plan, name) for plan in plans) for name in names})
