"""Problems on their way: roadmap after roadmap is proposed and searched, until a path is certified.

What a strategy's functions find (`compiled.py`) is counted, timed and certified. A path that cannot
be certified is searched around, never returned.
"""

import dataclasses
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import certify_edges
from gnnjax.planning.compiled import Compiled
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.query import Plan, make_plan, path_length
from gnnjax.planning.strategy import Strategy
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import GOAL, Roadmap
from gnnjax.search.knowledge import INVALID, Found, Knowledge
from gnnjax.search.shorten import PATH_POINTS


@dataclasses.dataclass(eq=False)
class Attempt:
    """The roadmaps of one attempt, and what is known of them."""

    roadmaps: Roadmap
    knowledge: Knowledge
    later: bool
    price: np.ndarray  # [P] nats, of the cheapest path when it was last searched; inf without one


# What is compiled at once: the first roadmaps and their search, the later ones, the shortening.
FIRST, LATER, SHORTEN = range(3)


class Batch:
    """P problems on their way: what was found and what it cost."""

    def __init__(
        self,
        robot: Robot,
        strategy: Strategy,
        options: PlannerOptions,
        compiled: Compiled,
        problems: Problem,
        seed: int,
        need: Callable[[int], None] | None = None,
    ):
        """Args:
        robot: the arm.
        strategy: how a problem is planned.
        options: limits.
        compiled: the strategy's functions.
        problems: `[P, ...]`.
        seed: of the roadmaps.
        need: called with a part of what is compiled before it is run, in nobody's time.
        """
        self.robot, self.strategy, self.options = robot, strategy, options
        self.compiled, self.problems, self.seed = compiled, problems, seed
        self.need, self._waited = need, 0.0
        num = len(problems.start)
        self.scenes = jax.tree.map(np.asarray, problems.scene)
        self.active = np.ones(num, bool)
        self.paths: list[np.ndarray | None] = [None] * num
        self.sampling_checks = np.full(num, 2)  # start and goal
        self.edge_checks, self.search_checks, self.roadmaps = np.zeros((3, num), int)
        self.planning_time, self.total_time = np.zeros((2, num))

    def run(self) -> list[Plan]:
        """Plans all problems."""
        kept: list[Attempt] = []
        for number in range(self.options.max_roadmaps):
            if not self._going_on().any():
                break
            attempt = self._begin(number)
            self._work(attempt, self.strategy.give_up)
            if self.strategy.give_up < np.inf:
                kept.append(attempt)
        # No roadmap had a likely path: now the unlikely ones, each problem's least unlikely first.
        order = np.argsort([attempt.price for attempt in kept], axis=0, kind="stable")
        for chosen in order:
            for number, attempt in enumerate(kept):
                rows = chosen == number
                if (rows & self._going_on()).any():
                    self._work(attempt, np.inf, rows)
        return self._plans()

    def warm_up(self, part: int) -> None:
        """Compiles a part of what planning needs, and plans nothing.

        The searches of the first and of the later roadmaps, and the shortening, each hold the
        collision kernel twice, for nodes and for edges, and a guide's prices; unrolled, these are
        nine tenths of what XLA compiles, 15 s each. So each is compiled when a query comes to it:
        half of the queries need the first alone.
        """
        nobody = self.active = np.zeros(len(self.active), bool)
        if part == SHORTEN:
            num, num_dof = self.problems.start.shape
            points = jnp.zeros((num, PATH_POINTS, num_dof))
            self._shorten_once(points, np.zeros(_path_status(num), np.int8), nobody)
            return
        self._search(self._begin(int(part == LATER)), nobody, 1, self.strategy.give_up)

    def _now(self, part: int | None = None) -> float:
        """Seconds on a clock that stands still while a part is compiled."""
        begin = time.perf_counter()
        if part is not None and self.need is not None:
            self.need(part)
        self._waited += time.perf_counter() - begin
        return time.perf_counter() - self._waited

    def _going_on(self) -> np.ndarray:
        """Which problems are still open and have time left, `[P]`."""
        return self.active & (self.total_time <= self.options.time_limit)

    def _begin(self, number: int) -> Attempt:
        """The roadmaps of an attempt."""
        active = self._going_on()
        later = number > 0 and self.strategy.has_later
        begin = self._now(LATER if later else FIRST)
        key = jax.random.fold_in(jax.random.key(self.seed), number)
        stored = self.strategy.stored(self.seed, number)
        propose = self.compiled.later if later else self.compiled.first
        sampled, knowledge = jax.block_until_ready(
            propose(self.strategy.weights, stored, key, self.problems, active)
        )
        taken = (self._now() - begin) / max(1, active.sum())
        self.total_time += np.where(active, taken, 0)
        self.sampling_checks += np.where(active, sampled.num_checks, 0)
        self.roadmaps += active
        return Attempt(sampled.roadmap, knowledge, later, np.full(len(active), np.inf))

    def _work(self, attempt: Attempt, max_price: float, rows: np.ndarray | bool = True) -> None:
        """Searches roadmaps until paths are certified, or too dear, or there are none."""
        begin, open_ = self._now(), self._going_on() & rows
        worked_on = open_.copy()
        if self.strategy.shorten:
            # Checked are single edges, which cannot be shortened. Longer paths are shortened first.
            found = self._search(attempt, open_, 1, max_price)
            likely = open_ & np.asarray(found.success) & (np.asarray(found.price) <= max_price)
            single = np.asarray(found.path)[:, 1] == GOAL
            self._certify(attempt, found, likely & single)
            self._shorten(found, likely & ~single)
            # What had no likely path has none when it is searched again.
            open_ &= self.active & likely
        while open_.any():
            found = self._search(attempt, open_, attempt.roadmaps.nodes.shape[1], max_price)
            open_ &= np.asarray(found.success)
            certified = self._certify(attempt, found, open_)
            if self.strategy.shorten:
                self._shorten(found, certified & (np.asarray(found.path)[:, 1] != GOAL))
            open_ &= ~certified
        taken = (self._now() - begin) / max(1, worked_on.sum())
        self.planning_time += np.where(worked_on, taken, 0)
        self.total_time += np.where(worked_on, taken, 0)

    def _search(
        self, attempt: Attempt, rows: np.ndarray, longest_checked: int, max_price: float
    ) -> Found:
        found, attempt.knowledge = jax.block_until_ready(
            self.compiled.search(
                self.strategy.weights,
                attempt.roadmaps,
                self.problems.scene,
                attempt.knowledge,
                np.int32(longest_checked),
                np.float32(max_price),
                rows,
                later=attempt.later,
            )
        )
        self._count(found, rows)
        attempt.price = np.where(rows, found.price, attempt.price)
        return found

    def _shorten(self, found: Found, rows: np.ndarray) -> None:
        """Shortens the paths of some problems, and keeps what is certified and shorter."""
        status = np.zeros(_path_status(len(rows)), np.int8)
        rows = rows.copy()
        if rows.any():
            self._now(SHORTEN)
        while rows.any():
            short, known = self._shorten_once(found.points, status, rows)
            rows &= np.asarray(short.success)
            status = np.array(known)
            for i in np.flatnonzero(rows):
                walked, certified = self._keep_if_certified(int(i), short)
                rows[i] = not certified.all()
                for step in np.flatnonzero(~certified):
                    ends = walked[[step, step + 1]]
                    status[i, ends, ends[::-1]] = INVALID

    def _shorten_once(
        self, points: jax.Array | None, status: np.ndarray, rows: np.ndarray
    ) -> tuple[Found, jax.Array]:
        short, known = jax.block_until_ready(
            self.compiled.shorten(self.strategy.weights, points, self.problems.scene, status, rows)
        )
        self._count(short, rows)
        return short, known

    def _certify(self, attempt: Attempt, found: Found, rows: np.ndarray) -> np.ndarray:
        """Keeps the certified paths of some problems, and notes which edges are not.

        Returns:
            `[P]`, true where a path was kept.
        """
        kept = np.zeros(len(rows), bool)
        for i in np.flatnonzero(rows):
            walked, certified = self._keep_if_certified(int(i), found)
            kept[i] = certified.all()
            if kept[i]:
                continue
            status = np.array(attempt.knowledge.status)
            for step in np.flatnonzero(~certified):
                for near, far in (walked[[step, step + 1]], walked[[step + 1, step]]):
                    slots = np.asarray(attempt.roadmaps.neighbors)[i, near] == far
                    status[i, near, slots] = INVALID
            attempt.knowledge = attempt.knowledge._replace(status=status)
        return kept

    def _keep_if_certified(self, i: int, found: Found) -> tuple[np.ndarray, np.ndarray]:
        """Keeps the path of problem i if it is certified, and shorter than what there is.

        Returns:
            The nodes of the path, and which of its edges are certified.
        """
        walked = np.asarray(found.path)[i]
        walked = walked[walked >= 0]
        path = np.asarray(found.waypoints)[i][: len(walked)]
        scene = jax.tree.map(lambda x: x[i], self.scenes)
        certified = certify_edges(self.robot, scene, path[:-1], path[1:])
        known = self.paths[i]
        if certified.all() and (known is None or path_length(path) < path_length(known)):
            self.paths[i] = path
            self.active[i] = False
        return walked, certified

    def _count(self, found: Found, rows: np.ndarray) -> None:
        self.edge_checks += np.where(rows, found.edge_checks, 0)
        self.search_checks += np.where(rows, found.configuration_checks, 0)

    def _plans(self) -> list[Plan]:
        return [
            make_plan(
                path,
                f"no path in the {self.roadmaps[i]} roadmaps tried ({self.strategy.describe})",
                self.robot.num_dof,
                edge_checks=int(self.edge_checks[i]),
                sampling_checks=int(self.sampling_checks[i]),
                search_checks=int(self.search_checks[i]),
                planning_time_s=float(self.planning_time[i]),
                total_time_s=float(self.total_time[i]),
                roadmaps=int(self.roadmaps[i]),
            )
            for i, path in enumerate(self.paths)
        ]


def _path_status(num: int) -> tuple[int, int, int]:
    """Shape of what is known of the path roadmaps of P problems."""
    return num, PATH_POINTS, PATH_POINTS
