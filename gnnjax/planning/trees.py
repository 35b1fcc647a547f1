"""Two trees of free motions, from start and goal, until they meet: RRT-Connect (Kuffner and
LaValle, 2000), with many branches at once and for many problems in step.

What is left to problems that roadmaps do not solve: it asks no guide, needs many checks, and finds
its way out of narrow places step by step. What a problem's trees are does not depend on the others.
"""

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.sequences import Items, PlacedScenes, SequenceTester
from gnnjax.planning.progress import Progress

MOST_ROUNDS = 50  # at effort 1
_BRANCHES = 64  # of a tree in a round, and as many of the other towards their tips
_STEP = 0.5  # configuration units of a branch's edges
_LONGEST = 2, 16  # edges of a branch, of the first tree and the other


class Tree:
    """Configurations that are joined to a root by free motions, of P problems."""

    def __init__(self, roots: np.ndarray, room: int):
        num, num_dof = roots.shape
        self.nodes = np.full((num, room, num_dof), np.inf, np.float32)
        self.nodes[:, 0] = roots
        self.parents = np.zeros((num, room), int)
        self.count = np.ones(num, int)

    def nearest(self, rows: np.ndarray, q: np.ndarray) -> np.ndarray:
        """The nodes of some problems that are nearest to q `[R D]`."""
        most = self.count[rows].max()
        apart = self.nodes[rows, :most] - q[:, None]
        return np.einsum("rnd,rnd->rn", apart, apart).argmin(axis=1)

    def add(self, row: int, parent: int, branch: np.ndarray) -> int:
        """Adds configurations one after the other; returns the last, or where there was no room."""
        for q in branch:
            at = int(self.count[row])
            if at == self.nodes.shape[1]:
                return parent
            self.nodes[row, at], self.parents[row, at] = q, parent
            self.count[row], parent = at + 1, at
        return parent

    def way(self, row: int, node: int) -> list[np.ndarray]:
        """From a node to the root."""
        found = [self.nodes[row, node]]
        while node:
            node = int(self.parents[row, node])
            found.append(self.nodes[row, node])
        return found


def grow(
    robot: Robot,
    progress: Progress,
    tester: SequenceTester,
    placed: PlacedScenes,
    ids: np.ndarray,
    seed: int,
    effort: int,
    time_limit: float,
) -> None:
    """Grows trees for problems without a path, whose paths go to `progress`.

    Args:
        robot: the arm.
        progress: of all problems.
        tester: of the arm.
        placed: scenes of all problems.
        ids: of the problems.
        seed: of the random configurations, the same for all.
        effort: how many times `MOST_ROUNDS`.
        time_limit: s, after which a problem's trees are left.
    """
    rounds = effort * MOST_ROUNDS
    room = 2 * _BRANCHES * rounds  # where there is none left, a tree stays as it is
    trees = [
        Tree(x[ids].astype(np.float32), room)
        for x in (progress.problems.start, progress.problems.goal)
    ]
    draws = np.random.default_rng([seed, 2]).random((rounds, _BRANCHES, robot.num_dof))
    # An end may lie in another turn of a joint.
    of_each = np.stack([progress.problems.start, progress.problems.goal])[:, ids].astype(np.float32)
    lower = np.minimum(robot.drawn_lower, of_each.min(axis=0))
    span = np.maximum(robot.drawn_upper, of_each.max(axis=0)) - lower
    for number, goals in enumerate(draws):
        still = progress.open(time_limit)
        rows = np.flatnonzero(still[ids])
        if not len(rows):
            return
        begin = progress.clock.now()
        progress.rounds[ids[rows]] += 1
        first, second = trees if number % 2 == 0 else trees[::-1]
        goal = np.tile(goals, (len(rows), 1))
        rows = np.repeat(rows, _BRANCHES)
        goal = (lower[rows] + goal * span[rows]).astype(np.float32)
        tips = _extend(progress, tester, placed, ids, first, rows, goal, _LONGEST[0])
        grown = tips >= 0
        rows, tips = rows[grown], tips[grown]
        if len(rows):
            goal = first.nodes[rows, tips]
            ends = _extend(progress, tester, placed, ids, second, rows, goal, _LONGEST[1])
            meet = ends >= 0
            meet[meet] = (second.nodes[rows[meet], ends[meet]] == goal[meet]).all(axis=1)
            paths = []
            met = (x[meet].tolist() for x in (rows, tips, ends))
            for row, tip, end in zip(*met, strict=True):
                way = first.way(row, tip)[::-1] + second.way(row, end)[1:]
                paths.append(np.stack(way if first is trees[0] else way[::-1]))
            progress.certify(ids[rows[meet]], paths)
        progress.spend(ids[np.flatnonzero(still[ids])], begin)


def _extend(
    progress: Progress,
    tester: SequenceTester,
    placed: PlacedScenes,
    ids: np.ndarray,
    tree: Tree,
    rows: np.ndarray,
    goal: np.ndarray,
    most: int,
) -> np.ndarray:
    """Extends trees towards configurations `[R D]` by up to `most` edges, as far as they are free.

    Returns:
        The last nodes that were added, -1 where none was.
    """
    near = tree.nearest(rows, goal)
    start = tree.nodes[rows, near]
    way = goal - start
    length = np.linalg.norm(way, axis=1)
    edges = np.clip(np.ceil(length / _STEP), 1, most).astype(int)
    of = np.repeat(np.arange(len(rows)), edges)
    step = np.arange(len(of)) - np.repeat(np.cumsum(edges) - edges, edges) + 1
    reached = step[:, None] * (_STEP / np.maximum(length, _STEP))[of][:, None]
    at = (start[of] + reached * way[of]).astype(np.float32)
    # The goal itself, not what rounding makes of it.
    at = np.where(step[:, None] * _STEP >= length[of][:, None] - 1e-6, goal[of], at)
    before = np.where((step == 1)[:, None], start[of], np.roll(at, 1, axis=0))
    items = Items(
        np.repeat(of, 2),
        np.repeat(ids[rows][of], 2),
        np.stack([at, before], axis=1).reshape(-1, at.shape[1]),
        np.repeat(at, 2, axis=0),
        np.tile([False, True], len(of)),
    )
    outcome = tester(placed, items, len(rows), progress.clock)
    progress.count(ids[rows], outcome)
    begin = np.cumsum(edges) - edges
    tips = np.full(len(rows), -1)
    for i, good in enumerate(outcome.num_valid // 2):
        if good:
            branch = at[begin[i] : begin[i] + good]
            tips[i] = tree.add(int(rows[i]), int(near[i]), branch)
    return tips
