"""Shortens paths by testing shortcuts between points of theirs.

Where a check costs less than a look at the guide, this is the quickest way to a short path: of the
motions between two of a path's points those are tested that a shorter way could lead along, the
most promising first, of all paths together and in a few flat calls. What comes out is the shortest
way along all that hold, as if all had been tested.
"""

from collections.abc import Sequence

import numpy as np

from gnnjax.collision.sequences import Items
from gnnjax.planning.batch import Batch
from gnnjax.planning.query import path_length

_POINTS = 14  # of a piece of a path, its corners among them
_PASSES = 3  # each along what the one before has found; long paths take more
_GAIN = 0.98  # of a path's length; where a pass leaves more, it was the last
_PIECES_AT_ONCE = 64
_MOTIONS_AT_ONCE = 16  # of a piece; of fewer, less is tested, but in more calls
_SHORTER = 1 - 1e-6  # of a length; less is rounding
_FIRST, _SECOND = np.triu_indices(_POINTS, 1)  # [E] the motions


def cut_short(batch: Batch, ids: np.ndarray) -> None:
    """Shortens the paths of some problems, and proves what comes out.

    Args:
        batch: has the paths, certified or not, and gets shorter ones.
        ids: of problems.
    """
    found = {i: path for i in ids.tolist() if (path := batch.best(i)) is not None}
    passes = dict.fromkeys(found, 0)
    while True:
        bent = [i for i, path in found.items() if len(path) > 2]
        bent = [i for i in bent if passes[i] < _PASSES or len(found[i]) > _POINTS]
        in_time = batch.in_time()
        bent = [i for i in bent if passes[i] < 3 * _PASSES and in_time[i]]
        if not bent:
            break
        begin = batch.clock.now()
        cut = []  # problem and piece of its path
        for i in bent:
            passes[i] += 1
            path = found[i]
            for first in range(0, len(path) - 1, _POINTS - 1):
                cut.append((i, path[first : first + _POINTS]))
        shorter: dict[int, list[np.ndarray]] = {i: [] for i in bent}
        for first in range(0, len(cut), _PIECES_AT_ONCE):
            some = cut[first : first + _PIECES_AT_ONCE]
            owners, pieces = zip(*some, strict=True)
            for i, piece in zip(owners, _cut(batch, np.array(owners), pieces), strict=True):
                shorter[i].append(piece)
        for i in bent:
            joined = np.concatenate([*(x[:-1] for x in shorter[i]), shorter[i][-1][-1:]])
            before, after = path_length(found[i]), path_length(joined)
            if after < before:
                found[i] = joined
                batch.keep(i, joined)
            if after > _GAIN * before:
                passes[i] = 3 * _PASSES
        batch.spend(np.array(bent), begin)
    batch.prove()


def _cut(batch: Batch, ids: np.ndarray, pieces: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The shortest ways `[L D]` along shortcuts of pieces of the paths of some problems."""
    points, edge = (np.stack(x) for x in zip(*map(_spread, pieces), strict=True))
    lengths = np.linalg.norm(points[:, _SECOND] - points[:, _FIRST], axis=2)
    # What lies along one edge of the path holds.
    free, refuted = edge[:, _FIRST] == edge[:, _SECOND - 1], np.zeros(lengths.shape, bool)
    while True:
        row, motion = _promising(lengths, free, refuted)
        if not len(row):
            known = np.where(free, lengths, np.inf)
            return [_shortest(*both) for both in zip(points, known, strict=True)]
        items = Items(
            np.arange(len(row)),
            ids[row],
            points[row, _FIRST[motion]],
            points[row, _SECOND[motion]],
            np.ones(len(row), bool),
        )
        outcome = batch.test(ids[row], items)
        free[row, motion], refuted[row, motion] = ~outcome.refuted, outcome.refuted


def _promising(
    lengths: np.ndarray, free: np.ndarray, refuted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of motions `[R E]` that are neither free nor refuted some that the shortest way may lead
    along: those with the shortest way through them, were all of these free.

    Returns:
        Their rows and numbers; none where no way is shorter than along what is free.
    """
    matrix = np.full((2, len(lengths), _POINTS, _POINTS), np.inf)
    matrix[:, :, _FIRST, _SECOND] = np.where(np.stack([~refuted, free]), lengths, np.inf)
    cost = np.zeros((2, len(lengths), _POINTS))
    for j in range(1, _POINTS):
        cost[:, :, j] = (cost[:, :, :j] + matrix[:, :, :j, j]).min(axis=2)
    after = np.zeros((len(lengths), _POINTS))
    for i in range(_POINTS - 2, -1, -1):
        after[:, i] = (matrix[0, :, i, i + 1 :] + after[:, i + 1 :]).min(axis=1)
    through = cost[0][:, _FIRST] + lengths + after[:, _SECOND]
    shorter = through < _SHORTER * cost[1, :, -1:]
    through = np.where(shorter & ~free & ~refuted, through, np.inf)
    order = np.argsort(through, axis=1, kind="stable")[:, :_MOTIONS_AT_ONCE]
    row, place = np.nonzero(np.isfinite(np.take_along_axis(through, order, axis=1)))
    return row, order[row, place]


def _spread(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points `[V D]` along a path, its corners among them, and the edge that leads on from each."""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    pieces = np.ones(len(lengths), int)
    while pieces.sum() < _POINTS - 1:  # the longest piece is cut next
        pieces[(lengths / pieces).argmax()] += 1
    edge = np.repeat(np.arange(len(lengths)), pieces)
    step = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = (step / pieces[edge])[:, None].astype(path.dtype)
    points = path[edge] + share * (path[edge + 1] - path[edge])
    return np.concatenate([points, path[-1:]]), edge


def _shortest(points: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """The shortest path `[L D]` from the first point to the last, over motions of some lengths."""
    matrix = np.full((len(points), len(points)), np.inf)
    matrix[_FIRST, _SECOND] = lengths
    cost, before = np.full(len(points), np.inf), np.zeros(len(points), int)
    cost[0] = 0
    for j in range(1, len(points)):
        through = cost[:j] + matrix[:j, j]
        before[j] = through.argmin()
        cost[j] = through[before[j]]
    way = [len(points) - 1]
    while way[-1]:
        way.append(before[way[-1]])
    return points[way[::-1]]
