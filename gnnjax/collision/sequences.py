"""Configurations of many problems, tested together.

A search wants its nodes and edges tested one after the other, until the first that does not hold.
Here the sequences of many searches are tested side by side, a stretch of each at a time, in flat
calls of one kernel over pairs of configuration and scene. What comes out for a sequence, and what
is counted, is what testing it alone and one by one would give.
"""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.clock import Clock
from gnnjax.collision.blocks import in_blocks, runs_of
from gnnjax.collision.checker import Checker
from gnnjax.collision.cloud import without_leaves
from gnnjax.collision.edges import bisection_order, most_intervals
from gnnjax.collision.exact import PartTests
from gnnjax.collision.levels import BLOCKED, CLOUD, ITSELF, names
from gnnjax.collision.one_call import decide
from gnnjax.kept import Kept, keep
from gnnjax.scene.scene import Scene

# Configurations in a call; one compilation each. A lone query should not pay for a full block.
_BLOCKS = (64, 256, 2048)
_TILE = 8  # of them share a scene: as many as fit into the machine's vectors
_OPEN_BLOCKS = (32, 256)  # of those that the first level leaves open
_EARLY = 2  # of these, in a sequence: most of them are blocked
_FIRST_STRETCH = 16  # configurations of a sequence in its first call, where many share it


class Items(NamedTuple):
    """What is to be tested: I configurations and motions, in the order of their sequences and
    within them."""

    sequence: np.ndarray  # [I] int, rising
    owner: np.ndarray  # [I] int, the problem whose scene counts
    starts: np.ndarray  # [I D] float32
    ends: np.ndarray  # [I D] float32; the ends of motions are not tested
    motion: np.ndarray  # [I] bool; false: the start is tested


class Outcome(NamedTuple):
    """What testing S sequences found out."""

    num_valid: np.ndarray  # [S] items that hold, before the first that does not
    refuted: np.ndarray  # [S] whether there is one that does not
    num_checks: np.ndarray  # [S] configurations, as a test one by one would count
    num_edges: np.ndarray  # [S] motions that were asked about


class PlacedScenes(NamedTuple):
    """Scenes of problems, as tests want them."""

    scenes: Any  # what `Checker.place` has made, on the device; without the points of clouds
    with_points: Any  # and with these
    numbers: np.ndarray  # [M] of the obstacles in a scene, from 0 on
    many: bool  # whether there are enough for large blocks


class SequenceTester:
    """Tests sequences for one robot."""

    def __init__(self, robot: Robot, checker: Checker, resolution: float):
        """Args:
        robot: the arm.
        checker: its collision functions.
        resolution: largest distance of neighbouring configurations of a motion.
        """
        self.checker = checker
        levels = checker.levels
        self._place = keep(checker.place)
        self._check = keep(checker.check_each if levels is None else levels.first)
        self._decide: Kept | None = None
        self._second = None
        if levels is not None:
            self._decide = keep(functools.partial(decide, levels))
            self._second = PartTests(*(test and keep(test) for test in levels.second))
        self._order = bisection_order(most_intervals(robot, resolution))
        self._resolution = resolution
        self.computed = 0  # configurations, with those that no sequential test would have needed

    def place(self, scenes: Scene) -> PlacedScenes:
        """Scenes `[P]`, padded to one of few numbers, for which kernels are compiled."""
        num, room = len(scenes.mask), 1
        while room < num:
            room *= 16 if room == 1 else 4
        rows = np.minimum(np.arange(room), num - 1)
        padded = jax.tree.map(lambda x: np.asarray(x)[rows], scenes)
        many = room * _FIRST_STRETCH > _BLOCKS[1]
        placed = self._place(padded)
        numbers = np.arange(scenes.mask.shape[1], dtype=np.int32)
        return PlacedScenes(without_leaves(placed), placed, numbers, many)

    def warm_up(self, placed: PlacedScenes, num_dof: int) -> None:
        """Compiles what testing in these scenes may need."""
        blocks, one_call = _blocks_for(placed), self._in_one_call(placed)
        if one_call is not None:
            rows = np.zeros((_BLOCKS[1] // _TILE, _TILE, num_dof), np.float32)
            nobody = np.zeros(rows.shape[:2], np.int32)
            asked = placed.numbers, nobody[:, 0], rows, nobody, nobody > 0
            jax.block_until_ready(one_call(placed.scenes, *asked))
        else:
            for block in blocks:
                rows = np.zeros((block // _TILE, _TILE, num_dof), np.float32)
                owner = np.zeros(len(rows), np.int32)
                jax.block_until_ready(self._check(placed.scenes, owner, rows))
        if self._second is not None:
            for block in _OPEN_BLOCKS[: len(blocks) - 1]:
                rows, owner = np.zeros((block, num_dof), np.float32), np.zeros(block, np.int32)
                asked = owner, rows, owner > 0
                jax.block_until_ready(self._second.clear_of_itself(*asked[1:]))
                if one_call is None:
                    apart = self._second.clear_of_obstacles(placed.scenes, owner, *asked)
                    jax.block_until_ready(apart)
                if self._second.clear_of_cloud is not None:
                    jax.block_until_ready(self._second.clear_of_cloud(placed.with_points, *asked))

    def _in_one_call(self, placed: PlacedScenes) -> Kept | None:
        """What decides on both levels, of few problems."""
        return None if placed.many else self._decide

    def __call__(
        self, placed: PlacedScenes, items: Items, num: int, clock: Clock | None = None
    ) -> Outcome:
        """Tests what is asked for.

        Args:
            placed: from `place`.
            items: what to test.
            num: S; sequences without items hold.
            clock: that stands still while something is compiled.
        """
        clock = clock or Clock()
        low, high, intervals, points = self._cut(items)
        total = np.bincount(items.sequence, weights=points, minlength=num).astype(int)
        begin = np.cumsum(points) - points  # of an item, over all sequences
        first = np.cumsum(total) - total  # of a sequence
        done, alive = np.zeros(num, int), total > 0
        checks, culprit = np.zeros(num, int), np.full(num, len(points))
        # A few may fill a block at once; many are mostly through with a few configurations each.
        stretch = max(_FIRST_STRETCH, _BLOCKS[0] // max(1, num))
        while alive.any():
            rows = np.flatnonzero(alive)
            size = np.minimum(max(stretch, _BLOCKS[0] // len(rows)), (total - done)[rows])
            of = np.repeat(np.arange(len(rows)), size)
            step = np.arange(len(of)) - np.repeat(np.cumsum(size) - size, size)
            at = (first + done)[rows][of] + step
            item = np.searchsorted(begin, at, side="right") - 1
            point = self._order[intervals[item], at - begin[item]]
            fraction = (point / intervals[item]).astype(np.float32)[:, None]
            q = low[item] + fraction * (high[item] - low[item])
            bad = np.flatnonzero(~self._test(placed, items.owner[item], q, of, clock))
            hit, where, _ = runs_of(of[bad])
            tested = size.copy()
            tested[hit] = step[bad[where]] + 1
            culprit[rows[hit]] = item[bad[where]]
            checks[rows] += tested
            done[rows] += size
            alive[rows] = (done < total)[rows]
            alive[rows[hit]] = False
            stretch *= 2
        refuted = culprit < len(points)
        return Outcome(
            num_valid=_count(items.sequence, np.arange(len(points)) < culprit[items.sequence], num),
            refuted=refuted,
            num_checks=checks,
            num_edges=_count(
                items.sequence,
                items.motion & (np.arange(len(points)) <= culprit[items.sequence]),
                num,
            ),
        )

    def _cut(self, items: Items) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Both ends of each item, its intervals, and how many configurations are to be tested."""
        starts = items.starts
        ends = np.where(items.motion[:, None], items.ends, starts)
        # Both directions of an edge test the very same floats, so that validity cannot depend on
        # the direction: the lexicographically smaller end comes first.
        at = np.arange(len(starts)), (starts != ends).argmax(axis=1)
        swap = (starts[at] > ends[at])[:, None]
        low, high = np.where(swap, ends, starts), np.where(swap, starts, ends)
        length = np.linalg.norm(high - low, axis=1)
        # NaN, or beyond the robot's range: cannot be tested at the resolution, so not valid.
        most = len(self._order) - 1
        testable = length <= self._resolution * most
        low[~testable] = np.nan
        intervals = np.clip(np.ceil(np.where(testable, length, 0) / self._resolution), 1, most)
        points = np.where(items.motion & testable, intervals - 1, 1)
        return low, high, intervals.astype(int), points.astype(int)

    def _test(
        self,
        placed: PlacedScenes,
        owner: np.ndarray,
        q: np.ndarray,
        sequence: np.ndarray,
        clock: Clock,
    ) -> np.ndarray:
        """Whether configurations `[B D]` are valid, each in the scene of its owner.

        Those that the first level leaves open are decided, but for what comes after one of the
        same sequence that is not valid.
        """
        found = self._run_tiles(placed, owner, q, sequence, clock)
        self.computed += len(q)
        if self._second is None:
            return found
        blocked = np.flatnonzero(found >= BLOCKED)
        first = np.full(sequence.max(initial=0) + 1, len(q))
        np.minimum.at(first, sequence[blocked], blocked)
        valid = found == 0
        rows = np.flatnonzero(~valid & (np.arange(len(q)) < first[sequence]))
        if not len(rows):
            return valid
        if len(rows) <= _OPEN_BLOCKS[0]:
            valid[rows] = self._run_open(placed, owner[rows], found[rows], q[rows], clock)
            return valid
        # The first ones of each sequence, and, where these hold, the others.
        _, begin, size = runs_of(sequence[rows])
        early = np.arange(len(rows)) - np.repeat(begin, size) < _EARLY
        for some in (early, ~early):
            some = rows[some & (rows < first[sequence[rows]])]
            if not len(some):
                continue
            valid[some] = self._run_open(placed, owner[some], found[some], q[some], clock)
            blocked = some[~valid[some]]
            np.minimum.at(first, sequence[blocked], blocked)
        return valid

    def _run_tiles(
        self,
        placed: PlacedScenes,
        owner: np.ndarray,
        q: np.ndarray,
        sequence: np.ndarray,
        clock: Clock,
    ) -> np.ndarray:
        """What the first level says of configurations; of few problems, what `decide` does."""
        # Those that lie side by side and have an owner in common share tiles.
        _, begin, size = runs_of(owner)
        tiles = -(-size // _TILE)
        first = np.cumsum(tiles) - tiles
        place = np.arange(len(owner)) + np.repeat(_TILE * first - begin, size)
        owners = np.repeat(owner[begin], tiles).astype(np.int32)
        rows = np.repeat(q[begin], _TILE * tiles, axis=0)  # what is left empty tests the first
        rows[place] = q
        rows = rows.reshape(len(owners), _TILE, q.shape[1])
        one_call, asked = self._in_one_call(placed), (owners, rows)
        blocks = tuple(block // _TILE for block in _blocks_for(placed))
        function = functools.partial(clock.call, self._check, placed.scenes)
        if one_call is not None:
            of, wanted = np.zeros(rows.shape[:2], np.int32), np.zeros(rows.shape[:2], bool)
            of.reshape(-1)[place], wanted.reshape(-1)[place] = sequence, True
            function = functools.partial(clock.call, one_call, placed.scenes, placed.numbers)
            blocks, asked = blocks[1:], (*asked, of, wanted)
        return in_blocks(function, blocks, *asked).reshape(-1)[place]

    def _run_open(
        self,
        placed: PlacedScenes,
        owner: np.ndarray,
        words: np.ndarray,
        q: np.ndarray,
        clock: Clock,
    ) -> np.ndarray:
        """Whether configurations are free of what the first level leaves open."""
        assert self._second is not None
        clear_of_obstacles, clear_of_itself, clear_of_cloud = self._second
        free = np.ones(len(q), bool)
        rows = np.flatnonzero(words & ITSELF)
        if len(rows):
            function = functools.partial(clock.call, clear_of_itself)
            free[rows] = in_blocks(function, _OPEN_BLOCKS, q[rows], free[rows])
        row, number = np.nonzero(names(words[:, None], placed.numbers) & free[:, None])
        if len(row):
            function = functools.partial(clock.call, clear_of_obstacles, placed.scenes)
            pairs = owner[row].astype(np.int32), number.astype(np.int32), q[row], free[row]
            held = ~in_blocks(function, _OPEN_BLOCKS, *pairs)
            free[row[held]] = False
        rows = np.flatnonzero((words & CLOUD > 0) & free)
        if len(rows) and clear_of_cloud is not None:
            function = functools.partial(clock.call, clear_of_cloud, placed.with_points)
            asked = owner[rows].astype(np.int32), q[rows], free[rows]
            free[rows] = in_blocks(function, _OPEN_BLOCKS, *asked)
        return free


def _blocks_for(placed: PlacedScenes) -> tuple[int, ...]:
    """The blocks that configurations are tested in: few problems do without the large one."""
    return _BLOCKS if placed.many else _BLOCKS[:2]


def _count(sequence: np.ndarray, chosen: np.ndarray, num: int) -> np.ndarray:
    return np.bincount(sequence[chosen], minlength=num)
