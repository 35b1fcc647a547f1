"""Configurations of many problems, tested together.

A search wants its nodes and edges tested one after the other, until the first that does not hold.
Here the sequences of many searches are tested side by side, a stretch of each at a time, in flat
calls of one kernel over pairs of configuration and scene. What comes out for a sequence, and what
is counted, is what testing it alone and one by one would give.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.checker import Checker, bisection_order, most_intervals
from gnnjax.collision.fused import BLOCKED, FREE, OPEN
from gnnjax.scene.scene import Scene

# Configurations in a call; one compilation each. A lone query should not pay for a full block.
_BLOCKS = (64, 512, 4096)
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
        self._check = jax.jit(checker.check_each if levels is None else levels.first)
        self._decide = None if levels is None else jax.jit(levels.second)
        self._order = bisection_order(most_intervals(robot, resolution))
        self._resolution = resolution
        self.computed = 0  # configurations, with those that no sequential test would have needed

    def warm_up(self, scenes: Scene, num_dof: int) -> None:
        """Compiles what testing in these scenes may need."""
        for block in _blocks_for(scenes):
            zeros = np.zeros((block, num_dof), np.float32)
            jax.block_until_ready(self._check(scenes, np.zeros(block, np.int32), zeros))
        if self._decide is not None:
            for block in _OPEN_BLOCKS[: len(_blocks_for(scenes)) - 1]:
                rows = np.zeros((block, num_dof), np.float32)
                jax.block_until_ready(self._decide(scenes, np.zeros(block, np.int32), rows))

    def __call__(self, scenes: Scene, items: Items, num: int) -> Outcome:
        """Tests what is asked for.

        Args:
            scenes: `[P]`, on the device.
            items: what to test.
            num: S; sequences without items hold.
        """
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
            bad = np.flatnonzero(~self._test(scenes, items.owner[item], q, of))
            hit, where = np.unique(of[bad], return_index=True)
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
        self, scenes: Scene, owner: np.ndarray, q: np.ndarray, sequence: np.ndarray
    ) -> np.ndarray:
        """Whether configurations `[B D]` are valid, each in the scene of its owner.

        Those that the first level leaves open are decided, but for what comes after one of the
        same sequence that is not valid.
        """
        found = self._run(self._check, _blocks_for(scenes), scenes, owner, q)
        self.computed += len(q)
        if self._decide is None:
            return found
        blocked = np.flatnonzero(found == BLOCKED)
        first = np.full(sequence.max(initial=0) + 1, len(q))
        np.minimum.at(first, sequence[blocked], blocked)
        rows = np.flatnonzero((found == OPEN) & (np.arange(len(q)) < first[sequence]))
        valid = found == FREE
        # The first ones of each sequence, and, where these hold, the others.
        _, begin, of = np.unique(sequence[rows], return_index=True, return_inverse=True)
        early = np.arange(len(rows)) - begin[of] < _EARLY
        for some in (early, ~early):
            some = rows[some & (rows < first[sequence[rows]])]
            if not len(some):
                continue
            valid[some] = self._run(self._decide, _OPEN_BLOCKS, scenes, owner[some], q[some])
            blocked = some[~valid[some]]
            np.minimum.at(first, sequence[blocked], blocked)
        return valid

    def _run(
        self,
        function: Callable[..., jax.Array],
        blocks: tuple[int, ...],
        scenes: Scene,
        owner: np.ndarray,
        q: np.ndarray,
    ) -> np.ndarray:
        """What a function says of configurations, asked in blocks of a few sizes."""
        parts, begin = [], 0
        while begin < len(q):
            left = len(q) - begin
            block = next((b for b in blocks if left <= b), blocks[-1])
            # Two calls of the middle size are less work than one that is mostly padding.
            while block > blocks[0] and left <= block // 4:
                block = blocks[blocks.index(block) - 1]
            end = min(begin + block, len(q))
            pad = begin + block - end
            rows = np.pad(q[begin:end], ((0, pad), (0, 0)), mode="edge")
            own = np.pad(owner[begin:end], (0, pad), mode="edge").astype(np.int32)
            parts.append((end - begin, function(scenes, own, rows)))
            begin = end
        # All are on their way before the first is waited for.
        return np.concatenate([np.asarray(found)[:num] for num, found in parts])


def _blocks_for(scenes: Scene) -> tuple[int, ...]:
    """The blocks that configurations are tested in: few problems do without the large one."""
    return _BLOCKS if len(scenes.mask) * _FIRST_STRETCH > _BLOCKS[1] else _BLOCKS[:2]


def _count(sequence: np.ndarray, chosen: np.ndarray, num: int) -> np.ndarray:
    return np.bincount(sequence[chosen], minlength=num)
