"""The engine: many problems on their way.

Straight lines come first. Where a check costs less than a look at the guide, two trees grow for
each problem that is left (`trees.py`), and what they find is cut short. Where it costs more,
roadmaps come before (`attempts.py`), all problems side by side: likely paths of some before
unlikely ones of any. A lone query is a batch of one. What a problem's path is and what it cost does
not depend on who shares its pool.
"""

import numpy as np

from gnnjax.collision.sequences import Items
from gnnjax.planning.attempts import Attempts
from gnnjax.planning.options import CHEAP
from gnnjax.planning.pool import Pool, sizes_up_to
from gnnjax.planning.query import Plan
from gnnjax.planning.shorten_by_tests import cut_short
from gnnjax.planning.trees import CHEAPLY, DRAWN, HASTY_ROUNDS, SPARINGLY, Outlook, grow
from gnnjax.search.knowledge import INVALID

_STRAIGHT = 1024  # straight lines that are tested at once
_GROWN = 1024  # problems whose trees are grown together; the last of them take long

# Roadmaps that are tried in the hope of a likely path before unlikely ones are tested, at effort 1.
_ROADMAPS_A_LEVEL = 4


class Run(Attempts):
    """A batch of P problems on its way: what was found and what it cost."""

    def run(self) -> list[Plan]:
        """Plans all problems."""
        every = np.arange(len(self.paths))
        # Sampled roadmaps are searched as other planners do; most have no such edge.
        for first in range(0, 0 if self.options.sampled else len(every), _STRAIGHT):
            self._test_straight_lines(every[first : first + _STRAIGHT])
        # Paths that are shortened afterwards wait for the certificate of what comes out.
        self.defers = not self._on_roadmaps
        self._search()
        if self.defers:
            had = np.array([self.best(i) is not None for i in range(len(every))], bool)
            cut_short(self, every)
            self.defers = False
            # What tests found free and no certificate does: a search that goes around it.
            self.wanted = had & np.array([path is None for path in self.paths], bool)
            if self.wanted.any():
                self._search()
                cut_short(self, np.flatnonzero(self.wanted))
        return self.plans([self._reason(i) for i in range(len(every))])

    @property
    def _on_roadmaps(self) -> bool:
        """Whether paths are looked for on roadmaps, before trees. They ask for fewer checks and for
        more looks at the guide, and their paths are shorter where nothing shortens them."""
        options = self.options
        return options.sampled or not self.strategy.shorten or options.check_cost > CHEAP

    def _search(self) -> None:
        if self._on_roadmaps:
            self._search_roadmaps()
        # A first look where checks are dear is one at likely paths.
        if not (self.options.sampled or (self._on_roadmaps and self.limits.is_hasty)):
            self._grow_trees()

    def _search_roadmaps(self) -> None:
        """Searches roadmaps for the problems that have no path."""
        every = np.arange(len(self.paths))
        last = min(self.options.max_roadmaps, _ROADMAPS_A_LEVEL * self.options.effort)
        if self.limits.is_hasty:
            last = 1
        for level in range(0, last, _ROADMAPS_A_LEVEL):
            for number in range(level, min(level + _ROADMAPS_A_LEVEL, last)):
                ids = self._open()
                self.roadmaps[ids] += 1
                self.attempt(ids, np.full(len(ids), number), self.strategy.give_up)
            # No roadmap had a likely path: now the unlikely ones, all that there are of a problem
            # side by side. The first roadmap is of another shape.
            for is_first in () if self.limits.is_hasty else (True, False):
                again = [
                    (i, one)
                    for i in self._open().tolist()
                    for one in self.set_aside[i]
                    if (one.number == 0) == is_first
                ]
                if again:
                    ids, aside = zip(*again, strict=True)
                    numbers = np.array([one.number for one in aside])
                    self.attempt(np.array(ids), numbers, np.inf, [one.known for one in aside])
            self.set_aside = [[] for _ in every]

    def _grow_trees(self) -> None:
        """Two trees for each problem that has no path."""
        schedule = CHEAPLY if self.options.check_cost <= CHEAP else SPARINGLY
        rounds = HASTY_ROUNDS if self.limits.is_hasty else schedule.rounds * self.options.effort
        ids = self._open()
        ends = np.concatenate([self.problems.start[ids], self.problems.goal[ids]], axis=1)
        ids = ids[np.isfinite(ends).all(axis=1)]  # of others there is nothing to grow from
        for first in range(0, len(ids), _GROWN):
            begin, some = self.clock.now(), ids[first : first + _GROWN]
            outlook = Outlook(self, self.strategy, some, self.chunk)
            self.spend(some, begin)
            grow(self, some, outlook, self.seed, schedule, rounds)

    def _reason(self, i: int) -> str:
        """Why there is no path of a problem."""
        tried = f"no path in {self.rounds[i]} rounds of growing trees from both ends"
        if self._on_roadmaps:
            tried = (
                f"no path in the {self.roadmaps[i]} roadmaps tried ({self.strategy.describe}), "
                f"{self.rounds[i]} rounds"
            )
        why = self.given_up(i, tried)
        if why != tried:
            return why
        more = "; more effort may find one"
        if self.robot.turns_more_than_once.any():
            more += ", or the goal in another turn (in_all_turns, --any-turn)"
        return tried + more

    def warm_up(self) -> None:
        """Compiles all that planning needs, and plans nothing."""
        num = len(self.paths)
        self.tester.warm_up(self.placed, self.robot.num_dof)
        numbers = range(1 if self.options.sampled else min(2, self.options.max_roadmaps))
        for number in numbers if self._on_roadmaps else ():
            most = min(num, self.pool, self.strategy.most_slots(number))
            for size in sizes_up_to(most):
                pool = Pool(size, self.clock)
                self.enter(pool, np.zeros(1, int), np.arange(1), np.arange(1), number, None)
                route, host = pool.route()
                if not self.strategy.is_judged:
                    self.judge(pool, np.zeros(1, int), route, host)
                pool.learn(route, *np.zeros((2, *host.path.shape), np.int8))
                if self.strategy.shorten:
                    self.shortener.shortcuts(pool, np.zeros(1, int), host)
        if not self.options.sampled:
            some = np.zeros((1, DRAWN, self.robot.num_dof), np.float32)
            outlook = Outlook(self, self.strategy, np.zeros(1, int), self.chunk)
            outlook.prices(np.zeros(1, int), some, some)

    def _open(self) -> np.ndarray:
        return np.flatnonzero(self.open() & self.wanted)

    def _test_straight_lines(self, ids: np.ndarray) -> None:
        """Tests the straight lines from starts to goals."""
        begin = self.clock.now()
        starts, goals = self.problems.start[ids], self.problems.goal[ids]
        items = Items(np.arange(len(ids)), ids, starts, goals, np.ones(len(ids), bool))
        outcome = self.test(ids, items)
        self.straight[ids] = INVALID
        free = ~outcome.refuted
        lines = [np.stack([self.problems.start[i], self.problems.goal[i]]) for i in ids[free]]
        begin = self.spend(ids, begin)
        self.certify(ids[free], lines)
        self.spend(ids, begin)
