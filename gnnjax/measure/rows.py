"""The result of one problem, as it goes to the file."""

import functools
from collections.abc import Callable

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.checker import make_checker
from gnnjax.devices import map_first, on_all_cores
from gnnjax.kept import keep
from gnnjax.planning.query import Plan
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import is_axis_aligned

# What is summed up over problems, and whether problems without a path count.
QUANTITIES = {
    "edge_checks": True,
    "configuration_checks": True,
    "sampling_checks": True,
    "search_checks": True,
    "planning_time_s": True,
    "total_time_s": True,
    "cost": False,
}

# What each problem's results have at least.
ROW = {"index", "valid", "hard", "success", "certified", "roadmaps", *QUANTITIES}


def make_row(index: int, plan: Plan, hard: bool) -> dict:
    """The result of one problem."""
    if not plan.valid:
        zeros = {name: 0 for name in QUANTITIES if name != "cost"}
        return {
            "index": index,
            "valid": False,
            "hard": hard,
            "success": False,
            "reason": f"invalid problem: {plan.reason}",
            "path": [],
            "cost": None,
            "certified": False,
            "roadmaps": 0,
            **zeros,
        }
    row = {"index": index, "hard": hard, **plan._asdict()}
    del row["trajectory"]
    row["path"] = plan.path.astype(float).tolist()
    row["cost"] = plan.cost if plan.success else None  # JSON has no infinity
    return row


def within(row: dict, time_limit: float) -> dict:
    """The row as it is, or as a failure where the path came too late."""
    if not row["success"] or row["total_time_s"] <= time_limit:
        return row
    reason = f"a path after {row['total_time_s']:.2f} s, and the limit is {time_limit} s"
    late = {"success": False, "reason": reason, "path": [], "cost": None, "certified": False}
    return row | late


def straight_line_blocked(robot: Robot, checker: str, problems: Problem) -> np.ndarray:
    """Tells for each problem whether the straight line from start to goal is blocked: the hard
    ones. That does not depend on the resolution a planner is asked for."""
    return on_all_cores(
        _blocked(robot, checker == "mjx", is_axis_aligned(problems.scene)), problems
    )


@functools.cache
def _blocked(robot: Robot, on_mjx: bool, axis_aligned: bool) -> Callable[..., jax.Array]:
    check = make_checker(robot, "mjx" if on_mjx else "fused", axis_aligned=axis_aligned)

    def blocked(problem: Problem) -> jax.Array:
        ends = problem.start[None], problem.goal[None]
        return ~check.check_edges(problem.scene, *ends).valid[0]

    return keep(functools.partial(map_first, blocked))
