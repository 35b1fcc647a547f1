"""Planners that take turns at each problem, so that whatever else the machine does slows all."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np

from experiments.turns import kept
from gnnjax.arm.robot import Robot
from gnnjax.measure.rows import make_row, straight_line_blocked
from gnnjax.planning.planner import Planner
from gnnjax.problems.problem import Problem

_BLOCK = 25  # problems that are planned before the results are kept
_Tree = TypeVar("_Tree")


def rows_of(tree: _Tree, rows: range) -> _Tree:
    """Consecutive rows of all arrays of a tree."""
    return jax.tree.map(lambda x: x[rows.start : rows.stop], tree)


def plan_in_turn(
    robot: Robot,
    makers: Mapping[str, Callable[[], Planner]],
    problems: Problem,
    seeds: tuple[int, ...],
    folder: Path,
) -> dict[str, list[list[dict]]]:
    """Plans every problem with all planners before the next one, as single queries.

    Args:
        robot: the arm.
        makers: of the planners, by name; not called where all results are there.
        problems: `[P]`.
        seeds: of the roadmaps.
        folder: where blocks of results are kept, to go on from; one for each choice of the others.

    Returns:
        for each planner, rows of `gnnjax.measure.rows` without paths, a list a seed.
    """
    num = len(problems.start)

    @functools.cache
    def ready() -> tuple[dict[str, Planner], np.ndarray]:
        planners = {name: make() for name, make in makers.items()}
        for name, planner in planners.items():
            print(f"compiling {name}", flush=True)
            planner.warm_up(jax.tree.map(lambda x: x[0], problems.scene))
        return planners, straight_line_blocked(robot, "fused", problems)

    warm: set[tuple[int, str]] = set()

    def block(seed: int, rows: range) -> dict[str, list[dict]]:
        planners, blocked = ready()
        found: dict[str, list[dict]] = {name: [] for name in planners}
        for i in rows:
            one = rows_of(problems, range(i, i + 1))
            for name, planner in planners.items():
                (plan,) = planner.plan_batch(one, seed=seed)
                if plan.valid and (seed, name) not in warm:
                    # The roadmaps of this seed are stored from now on.
                    warm.add((seed, name))
                    (plan,) = planner.plan_batch(one, seed=seed)
                found[name].append(make_row(i, plan, bool(blocked[i])) | {"path": []})
        print(f"seed {seed}: {rows.stop} of {num} problems", flush=True)
        return found

    planned: dict[str, list[list[dict]]] = {name: [] for name in makers}
    for seed in seeds:
        for rows in planned.values():
            rows.append([])
        for first in range(0, num, _BLOCK):
            rows = range(first, min(first + _BLOCK, num))
            path = folder / f"seed{seed}_{first}.json"
            part = kept(path, functools.partial(block, seed, rows))
            for name, found in planned.items():
                found[-1] += part[name]
    return planned
