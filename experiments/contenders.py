"""Planners against the clock: from arrays of problems to certified paths, by every core there is.

Processes share the problems, each on a core of its own. Ours plan a pool of problems at once,
OMPL's one problem after the other. Either way the clock runs from the arrays of all problems to the
last path: queries are checked, and paths certified.
"""

import functools
import multiprocessing
import os
import resource
import sys
import time
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm_options import load_arm
from gnnjax.evaluate import EvaluateConfig
from gnnjax.planning.load import make_planner
from gnnjax.planning.planner import Planner
from gnnjax.planning.processes import PlannerProcesses
from gnnjax.planning.query import Plan, QueryPlanner
from gnnjax.problems.problem import Problem
from gnnjax.problems.shards import load_problems

_HANDED_OUT = 8  # problems that a process is given at a time


class Turn(NamedTuple):
    """All problems planned once."""

    wall_s: float  # from the arrays of problems to the arrays of paths
    cores: float  # kept busy in the mean
    plans: list[Plan]


def in_pools(planner: QueryPlanner, problems: Problem, pool: int, seed: int) -> Turn:
    """Plans problems in batches that are as equal as can be, none of more than `pool`."""
    num = len(problems.start)
    batches = np.array_split(np.arange(num), -(-num // pool))
    plans: list[Plan] = []
    cpu = _cpu_time(planner)
    begin = time.perf_counter()
    for batch in batches:
        some = jax.tree.map(lambda x, at=batch: x[at], problems)
        plans += planner.plan_batch(some, seed=seed)
    wall = time.perf_counter() - begin
    return Turn(wall, (_cpu_time(planner) - cpu) / wall, plans)


def _cpu_time(planner: QueryPlanner) -> float:
    """Of this process and those that the planner has, s."""
    theirs = planner.cpu_time() if isinstance(planner, PlannerProcesses) else 0.0
    return time.process_time() + theirs


def in_processes(workers: Executor, case: EvaluateConfig, rows: np.ndarray) -> Turn:
    """Plans problems of a set one by one, each in the first process that is free for it.

    Args:
        workers: of `start_workers`.
        case: planner, robot, problem set and seed.
        rows: of the set.
    """
    begin = time.perf_counter()
    one = functools.partial(plan_one, case)
    found = list(workers.map(one, rows.tolist(), chunksize=_HANDED_OUT))
    wall = time.perf_counter() - begin
    return Turn(wall, sum(cpu for _, cpu in found) / wall, [plan for plan, _ in found])


def plan_one(case: EvaluateConfig, row: int) -> tuple[Plan, float]:
    """Plans one problem of a set, in a process that keeps planner and set; and the CPU time."""
    begin = time.process_time()
    one = jax.tree.map(lambda x: x[row : row + 1], problems_of(case))
    (plan,) = planner_of(case).plan_batch(one, seed=case.seed)
    return plan, time.process_time() - begin


@functools.cache
def planner_of(case: EvaluateConfig) -> QueryPlanner:
    """The planner of a case."""
    return make_planner(robot_of(case), case)


@functools.cache
def processes_of(case: EvaluateConfig, num: int) -> QueryPlanner:
    """The planner of a case in processes, which end with this one."""
    planner = planner_of(case)
    assert isinstance(planner, Planner)
    return PlannerProcesses(planner, num)


def robot_of(case: EvaluateConfig) -> Robot:
    """The arm of a case."""
    return load_arm(case)


@functools.cache
def problems_of(case: EvaluateConfig) -> Problem:
    """All problems of a case's set."""
    return load_problems(case.problems, robot_of(case)).problems


def start_workers(num: int) -> Executor:
    """Processes with a core each, as long as there are cores."""
    context: Any = multiprocessing.get_context("spawn")  # JAX has threads, which no fork survives
    numbers = context.SimpleQueue()
    for number in range(num):
        numbers.put(number)
    return ProcessPoolExecutor(num, context, _stay_on_core, (numbers,))


def _stay_on_core(numbers: Any) -> None:
    """Before JAX starts: it starts as many threads as it may use cores."""
    number = numbers.get()
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})


def peak_memory(case: EvaluateConfig, num: int) -> float:
    """Most memory, MiB, of a process that does nothing but plan so many problems at once."""
    context: Any = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as process:
        return process.submit(_peak_memory, case, num).result()


def _peak_memory(case: EvaluateConfig, num: int) -> float:
    problems = jax.tree.map(lambda x: x[:num], problems_of(case))
    planner = planner_of(case)
    planner.warm_up(jax.tree.map(lambda x: x[0], problems.scene), num)
    planner.plan_batch(problems, seed=case.seed)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (2**20 if sys.platform == "darwin" else 2**10)
