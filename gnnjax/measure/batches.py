"""Problems of a set, planned batch by batch, to the rows of a file of results."""

import contextlib
import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from gnnjax.collision.bounds import compile_certificates
from gnnjax.errors import InputError, is_out_of_memory
from gnnjax.measure.rows import make_row, straight_line_blocked, within
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.query import QueryPlanner
from gnnjax.problems.problem import Problem
from gnnjax.problems.shards import StoredProblems
from gnnjax.progress_bar import progress_bar


class Batches:
    """Plans some problems after others, a batch at a time.

    No result depends on who else is in its batch: batches may begin at any row, where a run was cut
    off, and may become smaller.

    Args:
        planner: what plans.
        options: its own.
        problems: the set.
        num: how many of them are planned at most.
        batch_size: problems planned at once, fewer where memory does not suffice.
        seed: of the planner.
        time_limit: seconds after which a path is a failure.
    """

    def __init__(
        self,
        planner: QueryPlanner,
        options: PlannerOptions,
        problems: StoredProblems,
        num: int,
        *,
        batch_size: int,
        seed: int,
        time_limit: float,
    ):
        self.num = num
        self._planner, self._options, self._problems = planner, options, problems
        self._size, self._seed, self._time_limit = batch_size, seed, time_limit
        self._compiled: set[Any] = set()  # sizes of batches, with shapes of scenes
        self._stored = False
        self._planned, self._spent = 0, 0.0
        self._progress = progress_bar()

    @contextlib.contextmanager
    def progress(self, total: int, completed: int = 0) -> Iterator[None]:
        """Shows how far planning is."""
        with self._progress:
            self._task = self._progress.add_task("compiling", total=total, completed=completed)
            yield

    def plan(self, first: int, last: int) -> Iterator[list[dict]]:
        """The rows of problems `first` to `last`, the latter not included."""
        asked = self._problems.part(first, last).problems
        num = last - first
        self._size = min(self._size, num)
        if not self._compiled:
            self._progress.console.print("compiling; the first time that takes up to a minute")
        compile_certificates(self._planner.robot)
        blocked = straight_line_blocked(self._planner.robot, self._options.checker, asked)
        done = 0
        while done < num:
            batch = np.arange(done, min(done + self._size, num))
            rows = self._rows(first, asked, batch, blocked)
            if rows is None:
                continue
            done += len(rows)
            name, planned = self._options.planner, self._planned
            words = f"{name}, {planned / self._spent:.3g} problems/s" if planned else "planning"
            self._progress.update(self._task, advance=len(rows), description=words)
            yield rows

    def _rows(
        self, first: int, asked: Problem, batch: np.ndarray, blocked: np.ndarray
    ) -> list[dict] | None:
        """Of a batch of what is asked; None where memory does not suffice, for fewer at once."""
        planner, seed = self._planner, self._seed
        queries = _take(asked, batch)
        try:
            shapes = self._size, *(x.shape[1:] for x in jax.tree.leaves(asked.scene))
            if shapes not in self._compiled:
                planner.warm_up(_take(asked.scene, 0), self._size)
                self._compiled.add(shapes)
            if not self._stored:  # the roadmaps of this seed are, from now on
                plans = planner.plan_batch(queries, seed=seed)
                self._stored = any(plan.valid for plan in plans)
            begin = time.perf_counter()
            plans = planner.plan_batch(queries, seed=seed)
            self._spent += time.perf_counter() - begin
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            smaller = _halved(self._size, error)
            self._progress.console.print(
                f"not enough memory for {self._size} problems at once; batch_size is halved to "
                f"{smaller}"
            )
            self._size = smaller
            return None
        self._planned += sum(plan.valid for plan in plans)
        return [
            within(make_row(first + i, plan, bool(blocked[i])), self._time_limit)
            for i, plan in zip(batch.tolist(), plans, strict=True)
        ]


def _take(problems: Any, rows: np.ndarray | int) -> Any:
    return jax.tree.map(lambda x: x[rows], problems)


def _halved(size: int, error: Exception) -> int:
    """Half the size of a batch that did not fit into memory; other errors go on."""
    if not is_out_of_memory(error):
        raise error
    if size == 1:
        raise InputError(f"not enough memory for one problem; ask for fewer nodes ({error})")
    return size // 2
