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
from gnnjax.planning.batch import Batch
from gnnjax.planning.guided import Guided
from gnnjax.planning.options import CHEAP, PlannerOptions
from gnnjax.planning.query import Plan
from gnnjax.planning.shorten_by_tests import cut_short
from gnnjax.planning.trees import CHEAPLY, DRAWN, HASTY_ROUNDS, SPARINGLY, Outlook, grow
from gnnjax.search.knowledge import INVALID

_STRAIGHT = 1024  # straight lines that are tested at once
_GROWN = 1024  # problems whose trees are grown together; the last of them take long

# Roadmaps that are tried in the hope of a likely path before unlikely ones are tested, at effort 1.
_ROADMAPS_A_LEVEL = 4


class Run:
    """A batch of P problems on its way."""

    def __init__(
        self, batch: Batch, strategy: Guided, options: PlannerOptions, seed: int, pool: int
    ):
        """Args:
        batch: of the problems, which `check_query` accepts; keeps books on them.
        strategy: has the guide, makes roadmaps and shortcuts.
        options: how much is tried.
        seed: of roadmaps and trees.
        pool: most problems on their way on roadmaps at once.
        """
        self.batch, self.strategy, self.options, self.seed = batch, strategy, options, seed
        self.attempts = Attempts(batch, strategy, options, seed, pool)
        self.wanted = np.ones(len(batch.paths), bool)  # whether a path is still looked for

    def run(self) -> list[Plan]:
        """Plans all problems."""
        batch, every = self.batch, np.arange(len(self.batch.paths))
        # Sampled roadmaps are searched as other planners do; most have no such edge.
        for first in range(0, 0 if self.options.sampled else len(every), _STRAIGHT):
            self._test_straight_lines(every[first : first + _STRAIGHT])
        # Paths that are shortened afterwards wait for the certificate of what comes out.
        batch.defers = not self._on_roadmaps
        self._search()
        if batch.defers:
            had = np.array([batch.best(i) is not None for i in range(len(every))], bool)
            cut_short(batch, every)
            batch.defers = False
            # What tests found free and no certificate does: a search that goes around it.
            self.wanted = had & np.array([path is None for path in batch.paths], bool)
            if self.wanted.any():
                self._search()
                cut_short(batch, np.flatnonzero(self.wanted))
        without = [i for i, path in enumerate(batch.paths) if path is None]
        reasons = {i: self._reason(i) for i in without}
        if not batch.limits.is_hasty:  # whose reasons nobody reads
            reasons |= batch.narrow_ends(without)
        return batch.plans([reasons.get(i, "") for i in range(len(every))])

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
        if not (self.options.sampled or (self._on_roadmaps and self.batch.limits.is_hasty)):
            self._grow_trees()

    def _search_roadmaps(self) -> None:
        """Searches roadmaps for the problems that have no path."""
        attempts, every = self.attempts, np.arange(len(self.batch.paths))
        last = min(self.options.max_roadmaps, _ROADMAPS_A_LEVEL * self.options.effort)
        if self.batch.limits.is_hasty:
            last = 1
        for level in range(0, last, _ROADMAPS_A_LEVEL):
            for number in range(level, min(level + _ROADMAPS_A_LEVEL, last)):
                ids = self._open()
                self.batch.roadmaps[ids] += 1
                attempts.attempt(ids, np.full(len(ids), number), self.strategy.give_up)
            # No roadmap had a likely path: now the unlikely ones, all that there are of a problem
            # side by side. The first roadmap is of another shape.
            for is_first in () if self.batch.limits.is_hasty else (True, False):
                again = [
                    (i, one)
                    for i in self._open().tolist()
                    for one in attempts.set_aside[i]
                    if (one.number == 0) == is_first
                ]
                if again:
                    ids, aside = zip(*again, strict=True)
                    numbers = np.array([one.number for one in aside])
                    attempts.attempt(np.array(ids), numbers, np.inf, [one.known for one in aside])
            attempts.set_aside = [[] for _ in every]

    def _grow_trees(self) -> None:
        """Two trees for each problem that has no path."""
        batch, ids = self.batch, self._open()
        schedule = CHEAPLY if self.options.check_cost <= CHEAP else SPARINGLY
        rounds = HASTY_ROUNDS if batch.limits.is_hasty else schedule.rounds * self.options.effort
        ends = np.concatenate([batch.problems.start[ids], batch.problems.goal[ids]], axis=1)
        ids = ids[np.isfinite(ends).all(axis=1)]  # of others there is nothing to grow from
        for first in range(0, len(ids), _GROWN):
            begin, some = batch.clock.now(), ids[first : first + _GROWN]
            outlook = self._outlook(some)
            batch.spend(some, begin)
            grow(batch, some, outlook, self.seed, schedule, rounds)

    def _reason(self, i: int) -> str:
        """Why there is no path of a problem."""
        batch = self.batch
        tried = f"no path in {batch.rounds[i]} rounds of growing trees from both ends"
        if self._on_roadmaps:
            tried = (
                f"no path in the {batch.roadmaps[i]} roadmaps tried ({self.strategy.describe}), "
                f"{batch.rounds[i]} rounds"
            )
        why = batch.given_up(i, tried)
        if why != tried:
            return why
        more = "; more effort may find one"
        if batch.robot.turns_more_than_once.any():
            more += ", or the goal in another turn (in_all_turns, --any-turn)"
        return tried + more

    def warm_up(self) -> None:
        """Compiles all that planning needs, and plans nothing."""
        self.batch.warm_up()
        if self._on_roadmaps:
            self.attempts.warm_up()
        if not self.options.sampled:
            some = np.zeros((1, DRAWN, self.batch.robot.num_dof), np.float32)
            self._outlook(np.zeros(1, int)).prices(np.zeros(1, int), some, some)

    def _outlook(self, ids: np.ndarray) -> Outlook:
        return Outlook(self.batch, self.strategy, ids, self.attempts.chunk)

    def _open(self) -> np.ndarray:
        return np.flatnonzero(self.batch.open() & self.wanted)

    def _test_straight_lines(self, ids: np.ndarray) -> None:
        """Tests the straight lines from starts to goals."""
        batch, begin = self.batch, self.batch.clock.now()
        starts, goals = batch.problems.start[ids], batch.problems.goal[ids]
        items = Items(np.arange(len(ids)), ids, starts, goals, np.ones(len(ids), bool))
        outcome = batch.test(ids, items)
        self.attempts.straight[ids] = INVALID
        free = ~outcome.refuted
        lines = list(np.stack([starts[free], goals[free]], axis=1))
        begin = batch.spend(ids, begin)
        batch.certify(ids[free], lines)
        batch.spend(ids, begin)
