"""Attempts on roadmaps: a pool of slots, each with a problem and a roadmap of its own, in rounds.

In a round, the cheapest path of every slot by what is known is found, what it meets is priced, what
is unknown on it is tested, all slots together in flat calls of one collision kernel, and what came
out is learned. Problems that are through leave, and waiting ones take their slots. The host loop
decides on a handful of numbers a slot.
"""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from gnnjax.guide.guide import RISK_WEIGHT
from gnnjax.planning.batch import Batch
from gnnjax.planning.guided import JUDGED, Guided
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.pool import Pool, in_chunks, size_for, sizes_up_to, take
from gnnjax.planning.shorten_by_guide import Shortener
from gnnjax.planning.steps import check_routes
from gnnjax.scene.scene import without_points
from gnnjax.search.knowledge import Knowledge
from gnnjax.search.rounds import Route

# Problems whose roadmaps are made or shortened at once; the first for lone queries. No array has
# room for one alone: a compiler that knows there is one merges other operations, and rounds
# otherwise.
_CHUNKS = (2, 16)
_MOST_ROUNDS = 40  # of a roadmap, at effort 1


@dataclasses.dataclass
class SetAside:
    """What is known of a roadmap whose best path is too unlikely, for later."""

    number: int
    known: Knowledge


class Attempts:
    """Attempts on roadmaps for the problems of a batch."""

    def __init__(
        self, batch: Batch, strategy: Guided, options: PlannerOptions, seed: int, pool: int
    ):
        """Args:
        batch: of P problems, which `check_query` accepts; keeps books on them.
        strategy: makes roadmaps and shortcuts, and prices them.
        options: how much is tried.
        seed: of the roadmaps.
        pool: most problems on their way at once.
        """
        self.batch, self.strategy, self.options = batch, strategy, options
        self.seed, self.pool = seed, pool
        self.chunk = _CHUNKS[pool > 1]
        self.shortener = Shortener(batch, strategy, self.chunk)
        num = len(batch.paths)
        self.straight = np.zeros(num, np.int8)  # status of the straight line
        self.set_aside: list[list[SetAside]] = [[] for _ in range(num)]

    def warm_up(self) -> None:
        """Compiles all that attempts need, and makes none."""
        for number in range(1 if self.options.sampled else min(2, self.options.max_roadmaps)):
            most = min(len(self.batch.paths), self.pool, self.strategy.most_slots(number))
            for size in sizes_up_to(most):
                pool = Pool(size, self.batch.clock)
                self.enter(pool, np.zeros(1, int), np.arange(1), np.arange(1), number, None)
                route, host = pool.route()
                if not self.strategy.is_judged:
                    self.judge(pool, np.zeros(1, int), route, host)
                pool.learn(route, *np.zeros((2, *host.path.shape), np.int8))
                if self.strategy.shorten:
                    self.shortener.shortcuts(pool, np.zeros(1, int), host)

    def attempt(
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
            max_price: nats; a roadmap whose best path is less likely is set aside.
            known: of roadmaps that were set aside.
        """
        if not len(ids):
            return
        most = self.strategy.most_slots(int(numbers[0]))
        pool = Pool(size_for(min(len(ids), self.pool, most)), self.batch.clock)
        slots = _Slots(*np.zeros((3, pool.size), int))
        waiting = 0
        while waiting < len(ids) or (pool.ids >= 0).any():
            free = np.flatnonzero(pool.ids < 0)
            if waiting < len(ids) and len(free) >= max(1, pool.size // 8):
                begin = self.batch.clock.now()
                entering = np.arange(waiting, min(waiting + len(free), len(ids)))
                rows = free[: len(entering)]
                for number in np.unique(numbers[entering]):
                    chosen = numbers[entering] == number
                    self.enter(pool, rows[chosen], ids, entering[chosen], int(number), known)
                slots.number[rows], slots.rounds[rows] = numbers[entering], 0
                slots.first_look[rows] = known is None and self.strategy.shorten
                waiting += len(entering)
                self.batch.spend(ids[entering], begin, planning=False)
            elif waiting == len(ids) and pool.is_wide():
                left = pool.shrink()
                slots = _Slots(*(x[left] for x in slots))
            self._round(pool, slots, max_price)

    def enter(
        self,
        pool: Pool,
        rows: np.ndarray,
        ids: np.ndarray,
        entering: np.ndarray,
        number: int,
        known: list[Knowledge] | None,
    ) -> None:
        """Puts problems into a pool.

        Args:
            pool: has room for them.
            rows: the slots.
            ids: of all problems of the attempt.
            entering: which of these enter.
            number: of their roadmaps.
            known: of roadmaps that were set aside, in the order of `ids`.
        """
        seen = self.batch.problems._replace(scene=without_points(self.batch.problems.scene))
        for part, padded in in_chunks(np.arange(len(entering)), self.chunk):
            chosen, padded = entering[part], entering[padded]
            problems = jax.tree.map(lambda x, at=ids[padded]: x[at], seen)
            entered = self.strategy.enter(
                self.batch.clock,
                problems,
                self.straight[ids[padded]],
                len(chosen),
                self.seed,
                number,
                self.batch.tester.checker,
            )
            if known is None:
                num_checks = np.asarray(entered.num_checks)[: len(chosen)]
                self.batch.sampling_checks[ids[chosen]] += num_checks
            priced = entered.priced
            if known is not None:
                earlier = [known[i] for i in padded]
                priced = priced._replace(known=jax.tree.map(lambda *x: np.stack(x), *earlier))
            pool.enter(rows[part], ids[chosen], priced, entered.reading)
        jax.block_until_ready(pool.priced)

    def _round(self, pool: Pool, slots: "_Slots", max_price: float) -> None:
        begin = self.batch.clock.now()
        live = np.flatnonzero(pool.ids >= 0)
        route, host = pool.route()
        slots.rounds[live] += 1
        np.add.at(self.batch.rounds, pool.ids[live], 1)
        begin = self.batch.spend(pool.ids[live], begin)
        live = self._leave(pool, slots, live, host, max_price)
        unjudged = host.unjudged[live].any(axis=1)
        if unjudged.any():
            self.judge(pool, live[unjudged], route, host)
            begin = self.batch.spend(pool.ids[live[unjudged]], begin)
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
            aside = SetAside(int(slots.number[row]), pool.known(int(row)))
            self.set_aside[pool.ids[row]].append(aside)
        late = ~self.batch.in_time()[pool.ids[live]]
        gone = none | dear | late | (slots.rounds[live] > _MOST_ROUNDS * self.options.effort)
        pool.ids[live[gone]] = -1
        return live[~gone]

    def judge(self, pool: Pool, rows: np.ndarray, route: Route, host: Route) -> None:
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
            readings = self.batch.clock.call(take, pool.reading, padded)
            found = self.batch.clock.call(
                self.strategy.looks.edges,
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
        begin = self.batch.clock.now()
        tested = check_routes(self.batch, pool.ids[rows], host, rows)
        through = rows[~tested.outcome.refuted]
        through = through[self.batch.certify_routes(pool.ids[through], through, host, tested.edges)]
        begin = self.batch.spend(pool.ids[rows], begin)
        longer = through[host.num[through] > 2]
        if len(longer) and self.strategy.shorten:
            self.shortener.shorten(pool, longer, host)
            begin = self.batch.clock.now()
        pool.ids[through] = -1
        left = rows[pool.ids[rows] >= 0]
        if len(left):
            pool.learn(route, tested.nodes, tested.edges)
            self.batch.spend(pool.ids[left], begin)


class _Slots(NamedTuple):
    """What the host knows of the slots of a pool."""

    number: np.ndarray  # [S] of the roadmap
    rounds: np.ndarray  # [S]
    # [S] 1 until a path was shortened: no path is checked as it is before that has failed.
    first_look: np.ndarray
