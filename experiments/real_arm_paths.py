"""Problems that are drawn for an arm, and the paths that planners find for them."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.carried_out import SWINGS, turnings
from experiments.cases import classical_case, own_case
from gnnjax.arm.robot import load_robot
from gnnjax.planning.load import make_planner
from gnnjax.planning.query import QueryPlanner
from gnnjax.problems.labelled import generate_labelled, problem_keys, to_problem_set
from gnnjax.problems.problem import Problem

OWN, RIVAL, PAPER = "guided", "ompl:rrt_connect@simplified", "gnn_paper"
SEEDS = 4  # as many times is planned where there is no path, or a joint swings along it
LIMIT_S = 2.0  # of RRT-Connect, for each seed


def draw_problems(arm: str, family: str, first: int, num: int) -> Problem:
    """Some of a kind's test problems, of which other experiments use the first."""
    robot = load_robot(arm)
    draw = generate_labelled(robot, 0, family=family)
    keys = problem_keys(0, "test", first, num, family)
    return to_problem_set(robot, draw(keys)).problems


def find_paths(arm: str, planner: str, problems: Problem, margin: float, seed: int) -> list[Any]:
    """The path that each problem gets, None without: the first, of up to four seeds, along which no
    joint swings, or else the one along which joints turn back least. The paper's network has one
    try, as in the paper."""
    search = _planner(arm, planner, margin)
    paths: list[Any] = [None] * len(problems.start)
    turns = np.full(len(paths), np.inf)
    for number in range(seed, seed + (1 if planner == PAPER else SEEDS)):
        left = np.flatnonzero(turns >= SWINGS)
        if not len(left):
            break
        plans = search.plan_batch(jax.tree.map(lambda x, i=left: x[i], problems), seed=number)
        for i, plan in zip(left.tolist(), plans, strict=True):
            found = turnings(plan.path).max() if plan.success else np.inf
            if found < turns[i]:
                turns[i], paths[i] = found, np.asarray(plan.path, float).tolist()
    return paths


@functools.cache
def _planner(arm: str, planner: str, margin: float) -> QueryPlanner:
    """One for all problems of an arm, so that it is compiled once."""
    case = classical_case(Path(), arm, planner)
    if planner == PAPER:
        case = own_case(Path(), arm, planner, num_nodes=1000)
    # The others give up by themselves, whatever else the machine does.
    limit = LIMIT_S if planner == RIVAL else np.inf
    case = dataclasses.replace(case, margin=margin, time_limit=limit)
    return make_planner(load_robot(arm), case)
