"""Two trees of free motions, from start and goal, until they meet: RRT-Connect (Kuffner and
LaValle, 2000), with many branches at once and for many problems in step.

How paths are found where a check costs less than a look at the guide; and where it costs more, for
problems that roadmaps do not solve. Branches may go anywhere, so that it finds its way out of
narrow places step by step; of many that could be tried, those are picked that are likely to be
free, in the guide's eyes, and lie on a short way. What a problem's trees are does not depend on the
others.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np

from gnnjax.collision.blocks import runs_of
from gnnjax.collision.sequences import Items
from gnnjax.planning.batch import Batch
from gnnjax.planning.guided import Guided
from gnnjax.planning.pool import in_chunks
from gnnjax.planning.progress import Progress
from gnnjax.planning.tree import Tree
from gnnjax.scene.scene import without_points

_AT_FIRST = 2 ** np.arange(3, 8)
DRAWN = int(_AT_FIRST.sum())  # branches that could be tried in a round


class Schedule(NamedTuple):
    """How much is tried in the rounds of two trees."""

    rounds: int  # at effort 1
    # Of how many branches each one of a round is picked, from some round on: at first of many,
    # those that are likely and lie on a short way. What narrow places need is unlikely, and goes
    # around: later they are picked from few, and lengths weigh less.
    choices: tuple[tuple[int, np.ndarray], ...]


# More branches than at first where checks are cheap, and a round costs as much with few.
CHEAPLY = Schedule(64, ((0, _AT_FIRST), (12, np.repeat(8, 31)), (24, np.repeat(4, 62))))
SPARINGLY = Schedule(100, ((0, _AT_FIRST), (24, np.append(2 ** np.arange(7), DRAWN - 127))))
HASTY_ROUNDS = 16  # of problems that are given up after a first look
# nats that a unit of length weighs at first, and rounds after which it weighs half as much
_LENGTH_WEIGHT, _HALVED = 4.0, 10
_STEP = 0.5  # configuration units of a branch's edges
_LONGEST = 4, 16  # edges of a branch, of the first tree and the other
_BRANCHES_AT_ONCE = 8192  # that are tested; of more, arrays would fill a gigabyte


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
    batch: Batch,
    ids: np.ndarray,
    outlook: Outlook,
    seed: int,
    schedule: Schedule,
    rounds: int,
) -> None:
    """Grows trees for problems without a path.

    Args:
        batch: of all problems, which gets the paths.
        ids: of the problems.
        outlook: for the same problems.
        seed: of the random configurations, the same for all.
        schedule: has the branches of a round.
        rounds: the most.
    """
    # An end may lie in another turn of a joint.
    ends = [x[ids].astype(np.float32) for x in (batch.problems.start, batch.problems.goal)]
    trees = [[Tree(root) for root in roots] for roots in ends]
    lower = np.minimum(batch.robot.drawn_lower, np.minimum(*ends))
    span = np.maximum(batch.robot.drawn_upper, np.maximum(*ends)) - lower
    rng = np.random.default_rng([seed, 2])
    for number in range(rounds):
        drawn = rng.random((DRAWN, batch.robot.num_dof))
        open_rows = np.flatnonzero(batch.open()[ids])
        if not len(open_rows):
            return
        begin = batch.clock.now()
        batch.rounds[ids[open_rows]] += 1
        first, second = trees if number % 2 == 0 else trees[::-1]
        goal = (lower[open_rows, None] + drawn * span[open_rows, None]).astype(np.float32)
        choices = next(some for begin, some in reversed(schedule.choices) if number >= begin)
        rows, near, goal = _likely(first, second, outlook, open_rows, goal, number, choices)
        tips = _extend(batch, ids, first, rows, near, goal, _LONGEST[0])
        grown = tips >= 0
        rows, tips = rows[grown], tips[grown]
        if len(rows):
            goal = np.stack([first[row].nodes[tip] for row, tip in zip(rows, tips, strict=True)])
            runs = zip(*runs_of(rows), strict=True)
            near = np.concatenate(
                [second[row].nearest(goal[at : at + num]) for row, at, num in runs]
            )
            others = _extend(batch, ids, second, rows, near, goal, _LONGEST[1])
            meet = [
                other >= 0 and (second[row].nodes[other] == q).all()
                for row, other, q in zip(rows, others, goal, strict=True)
            ]
            both = (tips, others) if first is trees[0] else (others, tips)
            _join(batch, ids, trees, rows[meet], *(x[meet] for x in both))
        batch.spend(ids[open_rows], begin)


def _join(
    batch: Batch,
    ids: np.ndarray,
    trees: list[list[Tree]],
    rows: np.ndarray,
    tips: np.ndarray,
    others: np.ndarray,
) -> None:
    """Hands in the paths of some problems along nodes `[R]` of both of their trees, which are the
    same configurations; of a path that is not certified, trees lose what hangs on its edges."""
    ways, paths = [], []
    for row, tip, other in zip(rows, tips.tolist(), others.tolist(), strict=True):
        own, beyond = trees[0][row].way(tip), trees[1][row].way(other)
        # Of each edge the tree that it is of, and the node that is farther from the root.
        ways.append([(0, node) for node in own[-2::-1]] + [(1, node) for node in beyond[:-1]])
        paths.append(
            np.concatenate([trees[0][row].nodes[own[::-1]], trees[1][row].nodes[beyond[1:]]])
        )
    certified = batch.certify_or_keep(ids[rows], paths)
    if certified is None:
        return
    for row, way, good in zip(rows, ways, certified, strict=True):
        for edge in np.flatnonzero(~good):
            of, node = way[edge]
            trees[of][row].cut(node)


def _likely(
    trees: list[Tree],
    others: list[Tree],
    outlook: Outlook,
    rows: np.ndarray,
    goals: np.ndarray,
    number: int,
    choices: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the branches towards configurations `[R DRAWN D]` those that are likely to be free, and to
    lie on short ways to the roots of the other trees.

    To take the best of all would grow what has room already; so each competes with its own.

    Args:
        trees: which grow, of all problems.
        others: the other ones.
        outlook: prices motions.
        rows: of problems.
        goals: configurations.
        number: of the round.
        choices: of how many each branch is the best.

    Returns:
        Of each branch its problem's row, the node that it leaves, and where to.
    """
    near = np.stack([trees[row].nearest(q) for row, q in zip(rows, goals, strict=True)])
    at = [(trees[row], nodes) for row, nodes in zip(rows, near, strict=True)]
    starts = np.stack([tree.nodes[nodes] for tree, nodes in at])
    ways = goals - starts
    length = np.linalg.norm(ways, axis=-1, keepdims=True)
    ends = starts + ways * np.minimum(1, _LONGEST[0] * _STEP / np.maximum(length, _STEP))
    price = outlook.prices(rows, starts, ends.astype(np.float32))
    roots = np.stack([others[row].nodes[:1] for row in rows])
    through = np.stack([tree.costs[nodes] for tree, nodes in at])
    through += np.linalg.norm(ends - starts, axis=-1) + np.linalg.norm(roots - ends, axis=-1)
    price += _LENGTH_WEIGHT / (1 + number / _HALVED) * through
    first = np.cumsum(choices) - choices
    groups = np.split(price, first[1:], axis=1)
    best = first + np.stack([group.argmin(axis=1) for group in groups], axis=1)
    own = np.arange(len(rows))[:, None]
    row = np.repeat(rows, best.shape[1])
    return row, near[own, best].ravel(), goals[own, best].reshape(len(row), -1)


def _extend(
    batch: Batch,
    ids: np.ndarray,
    trees: list[Tree],
    rows: np.ndarray,
    near: np.ndarray,
    goal: np.ndarray,
    most: int,
) -> np.ndarray:
    """Extends trees of some problems from nodes `[R]` towards configurations `[R D]` by up to
    `most` edges, as far as they are free.

    Returns:
        The last nodes that were added, -1 where none was.
    """
    if len(rows) > _BRANCHES_AT_ONCE:
        own = functools.partial(_extend, batch, ids, trees, most=most)
        parts = [slice(i, i + _BRANCHES_AT_ONCE) for i in range(0, len(rows), _BRANCHES_AT_ONCE)]
        return np.concatenate([own(rows[part], near[part], goal[part]) for part in parts])
    start = np.stack([trees[row].nodes[node] for row, node in zip(rows, near, strict=True)])
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
    outcome = batch.test(ids[rows], items)
    free = outcome.num_valid // 2
    branches = at[step <= free[of]]
    tips, own = np.full(len(rows), -1), np.flatnonzero(free)
    sizes = free[own]
    end = np.cumsum(sizes)
    for row, begin, num in zip(*runs_of(rows[own]), strict=True):
        some = own[begin : begin + num]
        held = branches[end[begin] - sizes[begin] : end[begin + num - 1]]
        tips[some] = trees[row].add(near[some], free[some], held)
    return tips
