"""Problems that are drawn for an arm, the paths that planners find for them, and what became of the
motions along these."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.carried_out import SWINGS, Conditions, carry_out, loaded, turnings
from experiments.cases import classical_case
from experiments.style import label
from experiments.turns import kept
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.devices import cache_compilations
from gnnjax.planning.load import make_planner
from gnnjax.planning.query import QueryPlanner, check_queries
from gnnjax.problems.labelled import generate_labelled, problem_keys, to_problem_set
from gnnjax.problems.problem import Problem

OWN, RIVAL, PAPER = "guided", "ompl:rrt_connect@simplified", "gnn_paper"
PLANNERS = (OWN, RIVAL, PAPER)
SEEDS = 4  # as many times is planned where there is no path, or a joint swings along it
LIMIT_S = 2.0  # of RRT-Connect, for each seed
PAPER_ARM = "kuka_iiwa14"  # which the paper's network was trained on


class Part(NamedTuple):
    """Problems that were drawn at once, and what became of them."""

    accepted: np.ndarray  # indices of those whose ends have the margin
    rows: dict[tuple[str, float], list[dict[str, Any]]]  # by planner and payload, of these


def measure_part(
    folder: Path,
    arm: str,
    family: str,
    first: int,
    num: int,
    payloads: Sequence[float],
    conditions: Conditions,
    seed: int,
) -> Part:
    """Draws problems, plans those whose ends have the margin, and carries the motions out; what is
    in the folder is done.

    Args:
        folder: of what is kept, for these very arguments.
        arm: the arm.
        family: kind of problems.
        first: of the problems.
        num: of problems.
        payloads: kg.
        conditions: under which motions are carried out.
        seed: the first of the planners.
    """

    @functools.cache
    def drawn() -> tuple[list[int], Problem]:
        problems = draw_problems(arm, family, first, num)
        reasons = check_queries(bare, problems, conditions.margin)
        good = np.flatnonzero([reason is None for reason in reasons])
        return good.tolist(), jax.tree.map(lambda x: np.asarray(x)[good], problems)

    def carried(planner: str, paths: list[Any], payload: float) -> list[dict[str, Any]]:
        robot, problems = loaded(arm, payload), drawn()[1]
        rows = carry_out(robot, problems, paths, conditions)
        again = [i for i, row in enumerate(rows) if row["held"] and row["found"] > row["timed"]]
        if not again or planner == PAPER or robot.torque_limit is None:
            return rows
        # They lead where its weight takes more than the motors may give, and planners are told so.
        weighed = robot.at_rest_within(1 - conditions.reserve)
        some = jax.tree.map(lambda x: np.asarray(x)[again], problems)
        found = find_paths(weighed, planner, some, conditions.margin, seed)
        for i, row in zip(again, carry_out(robot, some, found, conditions), strict=True):
            rows[i] = (row if row["timed"] else rows[i]) | {"again": True}
        return rows

    bare = load_robot(arm)
    accepted = np.array(kept(folder / "accepted.json", lambda: drawn()[0]), int)
    rows: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for planner in PLANNERS[: 3 if arm == PAPER_ARM else 2]:
        stem = planner.replace(":", "-")
        find = functools.partial(find_paths, bare, planner, margin=conditions.margin, seed=seed)
        paths = kept(folder / f"{stem}.json", lambda find=find: find(drawn()[1]))
        for payload in payloads:
            measure = functools.partial(carried, planner, paths, payload)
            own = kept(folder / f"{stem}_{payload:g}.json", measure)
            rows[planner, payload] = own
            line = f"{sum(row.get('suitable', False) for row in own)} of {len(own)} suitable"
            print(f"{folder.name}, {label(planner)}, {payload:g} kg: {line}", flush=True)
    return Part(accepted, rows)


def draw_problems(arm: str, family: str, first: int, num: int) -> Problem:
    """Some of a kind's test problems, of which other experiments use the first."""
    cache_compilations()
    robot = load_robot(arm)
    draw = generate_labelled(robot, 0, family=family)
    keys = problem_keys(0, "test", first, num, family)
    return to_problem_set(robot, draw(keys)).problems


def find_paths(
    robot: Robot, planner: str, problems: Problem, margin: float, seed: int
) -> list[Any]:
    """The path that each problem gets, None without: the first, of up to four seeds, along which no
    joint swings, or else the one along which joints turn back least. The paper's network has one
    try, as in the paper."""
    search = _planner(robot, planner, margin)
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
def _planner(robot: Robot, planner: str, margin: float) -> QueryPlanner:
    """One for all problems of an arm, so that it is compiled once."""
    case = classical_case(Path(), str(robot.path), planner)
    if planner == PAPER:
        case = dataclasses.replace(case, num_nodes=1000)
    # The others give up by themselves, whatever else the machine does.
    limit = LIMIT_S if planner == RIVAL else np.inf
    case = dataclasses.replace(case, margin=margin, time_limit=limit)
    return make_planner(robot, case)


def forget() -> None:
    """Frees what is compiled for the arms so far."""
    for function in (_planner, loaded, generate_labelled):
        function.cache_clear()
    jax.clear_caches()
