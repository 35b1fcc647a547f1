"""The engine: many problems on their way, in rounds.

A pool of slots holds one problem each. In a round, the cheapest path of every slot by what is known
is found, what it meets is priced, what is unknown on it is tested, all slots together in flat calls
of one collision kernel, and what came out is learned. Problems that are through leave, and waiting
ones take their slots. The host loop decides on a handful of numbers a slot; a lone query is a pool
of one. What a problem's path is and what it cost does not depend on who shares its pool.
"""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.sequences import Items, SequenceTester
from gnnjax.guide.guide import RISK_WEIGHT
from gnnjax.planning.guided import JUDGED, Guided
from gnnjax.planning.options import CHEAP, PlannerOptions
from gnnjax.planning.pool import Pool, in_chunks, size_for, sizes_up_to, take
from gnnjax.planning.progress import Progress
from gnnjax.planning.query import Plan
from gnnjax.planning.shortcuts import cut_short
from gnnjax.planning.shortening import Shortener
from gnnjax.planning.trees import grow
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import without_points
from gnnjax.search.knowledge import INVALID, Knowledge
from gnnjax.search.rounds import Route

# Problems whose roadmaps are made or shortened at once; the first for lone queries. No array has
# room for one alone: a compiler that knows there is one merges other operations, and rounds
# otherwise.
_CHUNKS = (2, 16)
_STRAIGHT = 1024  # straight lines that are tested at once

# Roadmaps that are tried in the hope of a likely path before unlikely ones are tested, and rounds
# of a roadmap, at effort 1.
_ROADMAPS_A_LEVEL, _MOST_ROUNDS = 4, 40


@dataclasses.dataclass
class Kept:
    """What is known of a roadmap whose best path is too unlikely, for later."""

    number: int
    known: Knowledge


class Run(Progress):
    """A batch of P problems on its way: what was found and what it cost."""

    def __init__(
        self,
        robot: Robot,
        strategy: Guided,
        options: PlannerOptions,
        tester: SequenceTester,
        problems: Problem,
        seed: int,
        pool: int,
        shares: int = 1,
    ):
        """Args:
        robot: the arm.
        strategy: makes roadmaps and shortcuts, and prices them.
        options: limits.
        tester: of the arm.
        problems: `[P, ...]`, which `check_query` accepts.
        seed: of the roadmaps.
        pool: most problems on their way at once.
        shares: runs that take place side by side.
        """
        super().__init__(robot, problems, shares)
        self.strategy, self.options = strategy, options
        self.tester, self.seed, self.pool = tester, seed, pool
        self.chunk = _CHUNKS[pool > 1]
        self.placed = tester.place(self.problems.scene)
        self.shortener = Shortener(self, strategy, tester, self.placed, self.chunk)
        num = len(self.paths)
        self.straight = np.zeros(num, np.int8)  # status of the straight line
        self.kept: list[list[Kept]] = [[] for _ in range(num)]

    def run(self) -> list[Plan]:
        """Plans all problems."""
        every = np.arange(len(self.paths))
        # Sampled roadmaps are searched as other planners do; most have no such edge.
        for first in range(0, 0 if self.options.sampled else len(every), _STRAIGHT):
            self._test_straight_lines(every[first : first + _STRAIGHT])
        last = min(self.options.max_roadmaps, _ROADMAPS_A_LEVEL * self.options.effort)
        for level in range(0, last, _ROADMAPS_A_LEVEL):
            for number in range(level, min(level + _ROADMAPS_A_LEVEL, last)):
                ids = self._open()
                self.roadmaps[ids] += 1
                self._attempt(ids, np.full(len(ids), number), self.strategy.give_up)
            # No roadmap had a likely path: now the unlikely ones, all that there are of a problem
            # side by side. The first roadmap is of another shape.
            for is_first in (True, False):
                again = [
                    (i, one)
                    for i in self._open().tolist()
                    for one in self.kept[i]
                    if (one.number == 0) == is_first
                ]
                if again:
                    ids, kept = zip(*again, strict=True)
                    numbers = np.array([one.number for one in kept])
                    self._attempt(np.array(ids), numbers, np.inf, [one.known for one in kept])
            self.kept = [[] for _ in every]
        if not self.options.sampled:
            self._grow_trees()
            if self.strategy.shorten and self.options.check_cost <= CHEAP:
                solved = np.flatnonzero([path is not None for path in self.paths])
                cut_short(self, self.tester, self.placed, solved)
        return self.plans([self._reason(i) for i in range(len(every))])

    def _grow_trees(self) -> None:
        """What is left to problems that no roadmap solves."""
        ids = self._open()
        ends = np.concatenate([self.problems.start[ids], self.problems.goal[ids]], axis=1)
        ids = ids[np.isfinite(ends).all(axis=1)]  # of others there is nothing to grow from
        for first in range(0, len(ids), self.pool):
            grow(
                self.robot,
                self,
                self.tester,
                self.placed,
                ids[first : first + self.pool],
                self.seed,
                self.options.effort,
                self.options.time_limit,
            )

    def _reason(self, i: int) -> str:
        """Why there is no path of a problem."""
        tried = (
            f"no path in the {self.roadmaps[i]} roadmaps tried ({self.strategy.describe}), "
            f"{self.rounds[i]} rounds"
        )
        if self.total_time[i] > self.options.time_limit:
            return f"{tried}, and {self.options.time_limit:g} s are over; give it more time"
        return f"{tried}; more effort may find one"

    def warm_up(self) -> None:
        """Compiles all that planning needs, and plans nothing."""
        num = len(self.paths)
        self.tester.warm_up(self.placed, self.robot.num_dof)
        numbers = range(1 if self.options.sampled else min(2, self.options.max_roadmaps))
        for number in numbers:
            most = min(num, self.pool, self.strategy.most_slots(number))
            for size in sizes_up_to(most):
                pool = Pool(size, self.clock, self.tester, self.placed)
                self._enter(pool, np.zeros(1, int), np.arange(1), np.arange(1), number, None)
                route, host = pool.route()
                if not self.strategy.is_judged:
                    self._judge(pool, np.zeros(1, int), route, host)
                pool.learn(route, *np.zeros((2, *host.path.shape), np.int8))
                if self.strategy.shorten:
                    self.shortener.shortcuts(pool, np.zeros(1, int), host)

    def _open(self) -> np.ndarray:
        return np.flatnonzero(self.open(self.options.time_limit))

    def _test_straight_lines(self, ids: np.ndarray) -> None:
        """Tests the straight lines from starts to goals."""
        begin = self.clock.now()
        starts, goals = self.problems.start[ids], self.problems.goal[ids]
        items = Items(np.arange(len(ids)), ids, starts, goals, np.ones(len(ids), bool))
        outcome = self.tester(self.placed, items, len(ids))
        self.count(ids, outcome)
        self.straight[ids] = INVALID
        free = ~outcome.refuted
        lines = [np.stack([self.problems.start[i], self.problems.goal[i]]) for i in ids[free]]
        begin = self.spend(ids, begin)
        self.certify(ids[free], lines)
        self.spend(ids, begin)

    def _attempt(
        self,
        ids: np.ndarray,
        numbers: np.ndarray,
        max_price: float,
        known: list[Knowledge] | None = None,
    ) -> None:
        """One roadmap for each of some problems, searched in a pool with refills.

        Args:
            ids: problems, some more than once.
            numbers: of their roadmaps; none is 0, or all are.
            max_price: nats; a roadmap whose best path is less likely is kept for later.
            known: of roadmaps that were kept.
        """
        if not len(ids):
            return
        most = self.strategy.most_slots(int(numbers[0]))
        pool = Pool(size_for(min(len(ids), self.pool, most)), self.clock, self.tester, self.placed)
        slots = _Slots(*np.zeros((3, pool.size), int))
        waiting = 0
        while waiting < len(ids) or (pool.ids >= 0).any():
            free = np.flatnonzero(pool.ids < 0)
            if waiting < len(ids) and len(free) >= max(1, pool.size // 8):
                begin = self.clock.now()
                entering = np.arange(waiting, min(waiting + len(free), len(ids)))
                rows = free[: len(entering)]
                for number in np.unique(numbers[entering]):
                    chosen = numbers[entering] == number
                    self._enter(pool, rows[chosen], ids, entering[chosen], int(number), known)
                slots.number[rows], slots.rounds[rows] = numbers[entering], 0
                slots.first_look[rows] = known is None and self.strategy.shorten
                waiting += len(entering)
                self.spend(ids[entering], begin, planning=False)
            elif waiting == len(ids) and pool.is_wide():
                left = pool.shrink()
                slots = _Slots(*(x[left] for x in slots))
            self._round(pool, slots, max_price)

    def _enter(
        self,
        pool: Pool,
        rows: np.ndarray,
        ids: np.ndarray,
        entering: np.ndarray,
        number: int,
        known: list[Knowledge] | None,
    ) -> None:
        for part, padded in in_chunks(np.arange(len(entering)), self.chunk):
            chosen, padded = entering[part], entering[padded]
            seen = self.problems._replace(scene=without_points(self.problems.scene))
            problems = jax.tree.map(lambda x, at=ids[padded]: x[at], seen)
            entered = self.strategy.enter(
                self.clock,
                problems,
                self.straight[ids[padded]],
                len(chosen),
                self.seed,
                number,
                self.tester.checker,
            )
            if known is None:
                self.sampling_checks[ids[chosen]] += np.asarray(entered.num_checks)[: len(chosen)]
            priced = entered.priced
            if known is not None:
                earlier = [known[i] for i in padded]
                priced = priced._replace(known=jax.tree.map(lambda *x: np.stack(x), *earlier))
            pool.enter(rows[part], ids[chosen], priced, entered.reading)
        jax.block_until_ready(pool.priced)

    def _round(self, pool: Pool, slots: "_Slots", max_price: float) -> None:
        begin = self.clock.now()
        live = np.flatnonzero(pool.ids >= 0)
        route, host = pool.route()
        slots.rounds[live] += 1
        np.add.at(self.rounds, pool.ids[live], 1)
        begin = self.spend(pool.ids[live], begin)
        live = self._leave(pool, slots, live, host, max_price)
        unjudged = host.unjudged[live].any(axis=1)
        if unjudged.any():
            self._judge(pool, live[unjudged], route, host)
            begin = self.spend(pool.ids[live[unjudged]], begin)
            live = live[~unjudged]
        to_shorten = (slots.first_look[live] > 0) & (host.num[live] > 2)
        rows, testing = live[to_shorten], live[~to_shorten]
        if len(rows):
            slots.first_look[rows] = 0
            pool.ids[rows[self.shortener.shorten(pool, rows, host)]] = -1
        if len(testing):
            self._test(pool, testing, route, host)

    def _leave(
        self, pool: Pool, slots: "_Slots", live: np.ndarray, host: Route, max_price: float
    ) -> np.ndarray:
        """Frees the slots whose roadmaps have no path, or none that is likely enough, or whose
        problems have no time left.

        Returns:
            The others.
        """
        price = host.edge_price[live].sum(axis=1) / RISK_WEIGHT
        none = host.num[live] == 0
        # What is not priced for good is not dear yet.
        dear = ~none & (price > max_price) & ~host.unjudged[live].any(axis=1)
        for row in live[dear]:
            kept = Kept(int(slots.number[row]), pool.known(int(row)))
            self.kept[pool.ids[row]].append(kept)
        late = self.total_time[pool.ids[live]] > self.options.time_limit
        gone = none | dear | late | (slots.rounds[live] > _MOST_ROUNDS * self.options.effort)
        pool.ids[live[gone]] = -1
        return live[~gone]

    def _judge(self, pool: Pool, rows: np.ndarray, route: Route, host: Route) -> None:
        """Has the guide look at the edges of some paths that it has not looked at."""
        steps = np.full((pool.size, JUDGED), -1)
        for row in rows:
            found = np.flatnonzero(host.unjudged[row])[:JUDGED]
            steps[row, : len(found)] = found
        price = np.zeros(steps.shape, np.float32)
        last = host.points.shape[1] - 1
        for part, padded in in_chunks(rows, self.chunk):
            at = padded[:, None], np.maximum(steps[padded], 0)
            starts, ends = host.points[at], host.points[at[0], np.minimum(at[1] + 1, last)]
            readings = self.clock.call(take, pool.reading, padded)
            found = self.clock.call(
                self.strategy.judge,
                self.strategy.weights,
                readings,
                starts,
                ends,
                np.int32(len(part)),
            )
            price[part] = np.asarray(found)[: len(part)]
        pool.reprice(route, steps, price)

    def _test(self, pool: Pool, rows: np.ndarray, route: Route, host: Route) -> None:
        """Tests the paths of some slots; what holds is certified, shortened, and leaves."""
        begin = self.clock.now()
        tested = pool.test(host, rows)
        self.count(pool.ids[rows], tested.outcome)
        through = rows[~tested.outcome.refuted]
        through = through[self.certify_routes(pool.ids[through], through, host, tested.edges)]
        begin = self.spend(pool.ids[rows], begin)
        longer = through[host.num[through] > 2]
        if len(longer) and self.strategy.shorten:
            self.shortener.shorten(pool, longer, host)
            begin = self.clock.now()
        pool.ids[through] = -1
        left = rows[pool.ids[rows] >= 0]
        if len(left):
            pool.learn(route, tested.nodes, tested.edges)
            self.spend(pool.ids[left], begin)


class _Slots(NamedTuple):
    """What the host knows of the slots of a pool."""

    number: np.ndarray  # [S] of the roadmap
    rounds: np.ndarray  # [S]
    # [S] 1 until a path was shortened: no path is checked as it is before that has failed.
    first_look: np.ndarray
