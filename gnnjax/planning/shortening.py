"""Shortens the paths of a pool in the guide's eyes, and checks what comes out."""

import jax
import numpy as np

from gnnjax.collision.sequences import SequenceTester
from gnnjax.planning.guided import Guided
from gnnjax.planning.pool import Pool, in_chunks, size_for, take
from gnnjax.planning.progress import Progress
from gnnjax.scene.scene import Scene
from gnnjax.search.knowledge import UNKNOWN
from gnnjax.search.rounds import Route

_MOST_SHORTCUTS = 8  # edges; what needs more is hardly ever free


class Shortener:
    """Shortens paths, and keeps books on it."""

    def __init__(
        self,
        progress: Progress,
        strategy: Guided,
        tester: SequenceTester,
        scenes: Scene,
        chunk: int,
    ):
        """Args:
        progress: of the problems; knows their best paths.
        strategy: finds shortcuts.
        tester: of the arm.
        scenes: of all problems, on the device.
        chunk: paths that are shortened at once.
        """
        self.progress, self.strategy, self.tester = progress, strategy, tester
        self.scenes, self.chunk = scenes, chunk

    def shorten(self, pool: Pool, rows: np.ndarray, host: Route) -> np.ndarray:
        """Shortens paths in the guide's eyes, checks them, and keeps what is certified and shorter.

        Returns:
            Of each row, whether a path was kept.
        """
        progress = self.progress
        begin = progress.clock.now()
        inner = self.shortcuts(pool, rows, host)
        num = inner.size
        asked, own, kept = np.zeros(num, int), np.arange(num), np.zeros(len(rows), bool)
        begin = progress.spend(pool.ids[rows], begin)
        while (inner.ids >= 0).any():
            live = np.flatnonzero(inner.ids >= 0)
            route, found = inner.route()
            begin = progress.spend(inner.ids[live], begin)
            gone = (found.num[live] == 0) | (
                (asked[live] >= _MOST_SHORTCUTS) & found.edge_unknown[live].any(axis=1)
            )
            inner.ids[live[gone]] = -1
            live = live[~gone]
            if not len(live):
                break
            tested = inner.test(found, live, _MOST_SHORTCUTS - asked[live])
            progress.count(inner.ids[live], tested.outcome)
            asked[live] += tested.outcome.num_edges
            begin = progress.spend(inner.ids[live], begin)
            left = found.edge_unknown[live] & (tested.edges[live] == UNKNOWN)
            through = live[~tested.outcome.refuted & ~left.any(axis=1)]
            ids = inner.ids[through]
            through = through[progress.certify_routes(ids, through, found, tested.edges)]
            begin = progress.spend(ids, begin)
            kept[own[through]], inner.ids[through] = True, -1
            if (inner.ids >= 0).any():
                inner.learn(route, tested.nodes, tested.edges)
                if inner.is_wide():
                    left = inner.shrink()
                    asked, own = asked[left], own[left]
        return kept

    def shortcuts(self, pool: Pool, rows: np.ndarray, host: Route) -> Pool:
        """The path roadmaps of the paths of some slots, in a pool of their own."""
        clock = self.progress.clock
        inner = Pool(size_for(len(rows)), clock, self.tester, self.scenes)
        for part, padded in in_chunks(np.arange(len(rows)), self.chunk):
            padded = rows[padded]
            readings = clock.call(take, pool.reading, padded)
            priced = clock.call(
                self.strategy.shortcuts,
                self.strategy.weights,
                readings,
                host.points[padded],
                np.int32(len(part)),
            )
            inner.enter(part, pool.ids[rows[part]], priced, ())
        jax.block_until_ready(inner.priced)
        return inner
