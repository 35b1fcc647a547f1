"""Two trees of free motions, from start and goal, until they meet: RRT-Connect (Kuffner and
LaValle, 2000), with many branches at once and for many problems in step.

What is left to problems that roadmaps do not solve. Branches may go anywhere, so that it finds its
way out of narrow places step by step; of many that could be tried, the guide picks those that are
likely to be free. What a problem's trees are does not depend on the others.
"""

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.sequences import Items, PlacedScenes, SequenceTester
from gnnjax.planning.guided import Guided
from gnnjax.planning.pool import in_chunks
from gnnjax.planning.progress import Progress
from gnnjax.scene.scene import without_points

MOST_ROUNDS = 100  # at effort 1
# Of how many branches the guide picks each one of a round. The first is left to chance: guides err,
# and with sixteen for each, fewer of MotionBenchMaker's problems were solved.
_CHOICES = 2 ** np.arange(7)
DRAWN = int(_CHOICES.sum())  # branches that could be tried in a round
_STEP = 0.5  # configuration units of a branch's edges
_LONGEST = 4, 16  # edges of a branch, of the first tree and the other
_ROOM = 64  # nodes a round and tree; where there is none left, a tree stays as it is
# Multiplications of a product of matrices; of more, libraries wake other cores, which takes longer
# than the product.
_PRODUCT = 1 << 18


class Tree:
    """Configurations that are joined to a root by free motions, of P problems."""

    def __init__(self, roots: np.ndarray, room: int):
        num, num_dof = roots.shape
        self.nodes = np.full((num, room, num_dof), np.inf, np.float32)
        self.nodes[:, 0] = roots
        self.halves = np.full((num, room), np.inf, np.float32)  # of squared lengths of nodes
        self.halves[:, 0] = _half_squared(roots)
        self.parents = np.zeros((num, room), int)
        self.count = np.ones(num, int)

    def nearest(self, rows: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Of some problems, which nodes `[R G]` are nearest to q `[R G D]`."""
        found = np.zeros(q.shape[:2], int)
        block = max(1, _PRODUCT // q[0].size)
        for at, row in enumerate(rows.tolist()):
            count, nodes = self.count[row], self.nodes[row]
            # What half the squared distances are, but for that of q from the origin.
            far = np.empty((len(q[at]), count), np.float32)
            for first in range(0, count, block):
                some = slice(first, min(first + block, count))
                far[:, some] = self.halves[row, some] - q[at] @ nodes[some].T
            found[at] = far.argmin(axis=1)
        return found

    def add(self, row: int, parent: int, branch: np.ndarray) -> int:
        """Adds configurations one after the other; returns the last, or where there was no room."""
        for q, half in zip(branch, _half_squared(branch), strict=True):
            at = int(self.count[row])
            if at == self.nodes.shape[1]:
                return parent
            self.nodes[row, at], self.halves[row, at], self.parents[row, at] = q, half, parent
            self.count[row], parent = at + 1, at
        return parent

    def way(self, row: int, node: int) -> list[np.ndarray]:
        """From a node to the root."""
        found = [self.nodes[row, node]]
        while node:
            node = int(self.parents[row, node])
            found.append(self.nodes[row, node])
        return found


def _half_squared(q: np.ndarray) -> np.ndarray:
    return np.einsum("nd,nd->n", q, q) / 2


class Outlook:
    """How likely motions are to be free in the scenes of some problems, as the guide sees them."""

    def __init__(self, progress: Progress, strategy: Guided, ids: np.ndarray, chunk: int):
        """Args:
        progress: of all problems.
        strategy: has the guide.
        ids: of the problems.
        chunk: problems that are looked at together.
        """
        self._clock, self._strategy, self._chunk = progress.clock, strategy, chunk
        scenes, parts = without_points(progress.problems.scene), []
        for part, padded in in_chunks(ids, chunk):
            some = jax.tree.map(lambda x, at=padded: x[at], scenes)
            num = len(part)
            own = strategy.weights, some, np.int32(num)
            found = self._clock.call(strategy.looks.read, *own)
            parts.append(jax.tree.map(lambda x, n=num: np.asarray(x)[:n], found))
        self._readings = jax.tree.map(lambda *x: np.concatenate(x), *parts)

    def prices(self, rows: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Prices `[R E]`, nats, of motions `[R E D]` of some of the problems."""
        found = []
        for part, padded in in_chunks(np.arange(len(rows)), self._chunk):
            readings = jax.tree.map(lambda x, at=rows[padded]: x[at], self._readings)
            own = self._strategy.weights, readings, starts[padded], ends[padded]
            price = self._clock.call(self._strategy.looks.branches, *own, np.int32(len(part)))
            found.append(np.asarray(price)[: len(part)])
        return np.concatenate(found)


def grow(
    robot: Robot,
    progress: Progress,
    tester: SequenceTester,
    placed: PlacedScenes,
    ids: np.ndarray,
    outlook: Outlook,
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
        outlook: for the same problems.
        seed: of the random configurations, the same for all.
        effort: how many times `MOST_ROUNDS`.
        time_limit: s, after which a problem's trees are left.
    """
    rounds = effort * MOST_ROUNDS
    # An end may lie in another turn of a joint.
    ends = [x[ids].astype(np.float32) for x in (progress.problems.start, progress.problems.goal)]
    trees = [Tree(x, _ROOM * rounds) for x in ends]
    lower = np.minimum(robot.drawn_lower, np.minimum(*ends))
    span = np.maximum(robot.drawn_upper, np.maximum(*ends)) - lower
    draws = np.random.default_rng([seed, 2]).random((rounds, DRAWN, robot.num_dof))
    for number, drawn in enumerate(draws):
        open_rows = np.flatnonzero(progress.open(time_limit)[ids])
        if not len(open_rows):
            return
        begin = progress.clock.now()
        progress.rounds[ids[open_rows]] += 1
        first, second = trees if number % 2 == 0 else trees[::-1]
        goal = (lower[open_rows, None] + drawn * span[open_rows, None]).astype(np.float32)
        rows, near, goal = _likely(first, outlook, open_rows, goal)
        tips = _extend(progress, tester, placed, ids, first, rows, near, goal, _LONGEST[0])
        grown = tips >= 0
        rows, tips = rows[grown], tips[grown]
        if len(rows):
            goal = first.nodes[rows, tips]
            near = second.nearest(rows, goal[:, None])[:, 0]
            others = _extend(progress, tester, placed, ids, second, rows, near, goal, _LONGEST[1])
            meet = others >= 0
            meet[meet] = (second.nodes[rows[meet], others[meet]] == goal[meet]).all(axis=1)
            paths = []
            met = (x[meet].tolist() for x in (rows, tips, others))
            for row, tip, other in zip(*met, strict=True):
                way = first.way(row, tip)[::-1] + second.way(row, other)[1:]
                paths.append(np.stack(way if first is trees[0] else way[::-1]))
            progress.certify_or_keep(ids[rows[meet]], paths)
        progress.spend(ids[open_rows], begin)


def _likely(
    tree: Tree, outlook: Outlook, rows: np.ndarray, goals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the branches towards configurations `[R DRAWN D]` those that are likely to be free.

    To take the likeliest of all would grow what has room already; so each competes with its own.

    Returns:
        Of each branch its problem's row, the node that it leaves, and where to.
    """
    near = tree.nearest(rows, goals)
    starts = tree.nodes[rows[:, None], near]
    ways = goals - starts
    length = np.linalg.norm(ways, axis=-1, keepdims=True)
    ends = starts + ways * np.minimum(1, _LONGEST[0] * _STEP / np.maximum(length, _STEP))
    price = outlook.prices(rows, starts, ends.astype(np.float32))
    first = np.cumsum(_CHOICES) - _CHOICES
    groups = np.split(price, first[1:], axis=1)
    best = first + np.stack([group.argmin(axis=1) for group in groups], axis=1)
    own = np.arange(len(rows))[:, None]
    row = np.repeat(rows, best.shape[1])
    return row, near[own, best].ravel(), goals[own, best].reshape(len(row), -1)


def _extend(
    progress: Progress,
    tester: SequenceTester,
    placed: PlacedScenes,
    ids: np.ndarray,
    tree: Tree,
    rows: np.ndarray,
    near: np.ndarray,
    goal: np.ndarray,
    most: int,
) -> np.ndarray:
    """Extends trees from nodes `[R]` towards configurations `[R D]` by up to `most` edges, as far
    as they are free.

    Returns:
        The last nodes that were added, -1 where none was.
    """
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
