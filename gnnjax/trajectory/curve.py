"""Paths with rounded corners: curves whose second derivative is continuous.

A corner is replaced, from `blend` before it to `blend` behind it, by a quartic with control points
A, (A + P) / 2, P, (P + B) / 2, B. Its derivative turns from one edge's direction to the next like
3 w^2 - 2 w^3, so that it meets both edges with no second derivative, and the parameter of the whole
curve is the length `s` of the path before it was rounded.

A corner with blend 0 is none to pass at speed: the motion stops there.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

_STRAY = 3 / 16  # of the quartic's middle from its corner, as a share of blend times turn
# Of a path: steps that are none, well above the lengths that rounding makes zero below.
_REPEATED = 1e-11
_BLEND_INTERVALS, _FEWEST = 16, 4  # of a blend; of a straight piece at least


class Curve(NamedTuple):
    """A rounded path of C corners, those of padding with `turns` and `blends` zero at its end."""

    start: Float[Array, "*batch D"]
    direction: Float[Array, "*batch D"]  # of the first edge, of length 1; zero: nothing moves
    turns: Float[Array, "*batch C D"]  # change of direction at the corners
    corners: Float[Array, "*batch C"]  # their s, configuration units
    blends: Float[Array, "*batch C"]  # configuration units
    # Of N intervals: which are blends (see `make_curve`), and s of all grid points.
    entries: Int[Array, "*batch C"]  # grid point where a corner's blend begins
    exits: Int[Array, "*batch C"]  # where it ends; one more than the entry at a stop
    grid: Float[Array, "*batch N+1"]  # s, configuration units, ascending
    stops: Int[Array, "*batch N+1"]  # 1 where the motion rests, else 0


class Places(NamedTuple):
    """Places on a curve, with its derivatives by s."""

    q: Float[Array, "*batch D"]
    slope: Float[Array, "*batch D"]
    bend: Float[Array, "*batch D"]


def distinct(path: np.ndarray) -> np.ndarray:
    """A path `[L D]` in double precision without configurations that repeat the one before, up to
    rounding; its ends are what they are."""
    path = np.asarray(path, float)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    kept = path[np.concatenate([[True], steps > _REPEATED * steps.sum()])]
    if len(kept) > 1:
        kept[-1] = path[-1]
    return kept


def edges_of(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lengths `[E]` and directions `[E D]` of the edges of a path without repetitions."""
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    return lengths, steps / lengths[:, None]


def size_of(path: np.ndarray) -> int:
    """To how many corners a path is padded, so that few sizes are compiled."""
    size = 2
    while size < len(path) - 2:
        size *= 2
    return size


def make_curve(path: np.ndarray, blends: np.ndarray, size: int) -> Curve:
    """The curve of a path without repetitions.

    The grid has 24 (size + 2) intervals. Every piece has a whole number of equal ones: 16 a
    blend, one of length zero a stop, and the straight pieces share the others by their lengths.

    Args:
        path: `[L D]`.
        blends: `[L - 2]`, or none for a path without corners.
        size: C, at least as many as there are corners.
    """
    lengths, directions = edges_of(path)
    number, num_dof = max(0, len(path) - 2), path.shape[1]
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    corners = ends[1:-1]
    turns, at = np.zeros((size, num_dof)), np.full(size, ends[-1])
    wide = np.zeros(size)
    turns[:number], at[:number], wide[:number] = np.diff(directions, axis=0), corners, blends

    # Pieces: straight, corner, straight, ..., straight.
    knots = np.concatenate([[0.0], np.stack([at - wide, at + wide], 1).ravel(), ends[-1:]])
    # Two blends that meet leave nothing between them but rounding.
    knots = np.maximum.accumulate(knots)
    straight = np.diff(knots)[::2]
    straight = np.where(straight > 1e-12 * ends[-1], straight, 0.0)
    total, counts = grid_size(size), np.zeros(2 * size + 1, int)
    counts[1 : 2 * number : 2] = np.where(wide[:number] > 0, _BLEND_INTERVALS, 1)
    counts[::2] = np.where(straight > 0, _FEWEST, 0)
    left = total - counts.sum()
    if straight.any():
        shares = left * straight / straight.sum()
        counts[::2] += np.diff(np.round(np.concatenate([[0.0], np.cumsum(shares)]))).astype(int)
    else:  # blends alone, or nothing that moves
        counts[1 if number else 0] += left
    index = np.concatenate([[0], np.cumsum(counts)])
    steps = np.diff(knots) / np.maximum(counts, 1)
    inside = np.arange(total) - np.repeat(index[:-1], counts)
    grid = np.repeat(knots[:-1], counts) + inside * np.repeat(steps, counts)
    entries, exits = index[1:-1:2], index[2:-1:2]
    stops = np.zeros(total + 1, int)
    stops[[0, -1]] = 1
    halts = np.flatnonzero(wide[:number] == 0)
    stops[entries[halts]] = stops[exits[halts]] = 1
    return Curve(
        path[0],
        directions[0] if len(directions) else np.zeros(num_dof),
        turns,
        at,
        wide,
        entries,
        exits,
        np.append(grid, ends[-1]),
        stops,
    )


def grid_size(size: int) -> int:
    """How many intervals the grid of a curve padded to so many corners has."""
    return 24 * (size + 2)


def cut(curve: Curve, first: int, last: int) -> Curve:
    """A curve between two grid points, with `s` from 0, of the least size that has room for it; its
    grid ends with intervals of no length."""
    inside = (curve.entries >= first) & (curve.exits <= last) & (curve.blends > 0)
    own, size = np.flatnonzero(inside), 2
    while size < len(own) or grid_size(size) < last - first:
        size *= 2
    total, begin = grid_size(size), places(curve, np.array([float(first)]))
    points = np.minimum(first + np.arange(total + 1), last)
    grid = curve.grid[points] - curve.grid[first]

    def padded(values: np.ndarray, padding: int | float) -> np.ndarray:
        found = np.full((size, *values.shape[1:]), padding, values.dtype)
        found[: len(own)] = values
        return found

    return Curve(
        begin.q[0],
        begin.slope[0],
        padded(curve.turns[own], 0.0),
        padded(curve.corners[own] - curve.grid[first], grid[-1]),
        padded(curve.blends[own], 0.0),
        padded(curve.entries[own] - first, total),
        padded(curve.exits[own] - first, total),
        grid,
        curve.stops[points],
    )


def places(curve: Curve, at: Float[Array | np.ndarray, " P"]) -> Places:
    """Places of one curve at grid indices, which may lie between two; stops turn at once, behind
    the middle of their interval. NumPy's for NumPy's."""
    xp = at.__array_namespace__()
    interval = xp.clip(xp.floor(at), 0, curve.grid.shape[-1] - 2).astype(int)
    s = curve.grid[interval] + (at - interval) * xp.diff(curve.grid)[interval]
    row, w = _corner_at(curve, interval, at)
    stop = curve.blends[row] == 0
    w = xp.where(stop, xp.round(xp.clip(w, 0.0, 1.0)), xp.clip(w, 0.0, 1.0))
    width = 2 * curve.blends[row]
    # How far the new direction was gone: the integral of its share, and s behind the blend.
    behind = xp.maximum(s - (curve.corners + curve.blends)[row], 0.0)
    gone = width * w**3 * (1 - w / 2) + behind
    share = w**2 * (3 - 2 * w)
    bend = xp.where(stop, 0.0, 6 * w * (1 - w) / xp.where(stop, 1.0, width))
    # What the corners before have turned, as if it had turned at them.
    turns, none = curve.turns, xp.zeros_like(curve.turns[:1])
    turned = xp.concatenate([none, xp.cumsum(turns, axis=0)[:-1]])
    shifted = xp.concatenate([none, xp.cumsum(curve.corners[:, None] * turns, axis=0)[:-1]])
    slope, turn = (curve.direction + turned)[row], turns[row]
    return Places(
        (curve.start - shifted)[row] + s[:, None] * slope + gone[:, None] * turn,
        slope + share[:, None] * turn,
        bend[:, None] * turn,
    )


def thirds(curve: Curve, at: Float[Array | np.ndarray, " P"]) -> Float[Array | np.ndarray, "P D"]:
    """Third derivatives of one curve by s at grid indices; they leap at the ends of blends."""
    xp = at.__array_namespace__()
    row, w = _corner_at(curve, at, at)
    blend = curve.blends[row]
    inside = (w >= 0) & (w <= 1) & (blend > 0)
    width = xp.where(blend > 0, 2 * blend, 1.0)
    return xp.where(inside, 6 * (1 - 2 * w) / width**2, 0.0)[:, None] * curve.turns[row]


def _corner_at(curve: Curve, interval: Any, at: Any) -> tuple[Any, Any]:
    """The first corner `[P]` that is not passed in intervals, or the last one, and which share of
    its blend is: below 0 before it, above 1 behind it."""
    xp = at.__array_namespace__()
    row = xp.searchsorted(curve.exits, interval, side="right")
    row = xp.minimum(row, len(curve.exits) - 1)
    span = xp.maximum(curve.exits - curve.entries, 1)
    return row, (at - curve.entries[row]) / span[row]


def straight_pieces(path: np.ndarray, blends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends `[E D]` twice of what is left between blends `[L - 2]` of a path without repetitions;
    of a single configuration, that twice."""
    if len(path) == 1:
        return path, path
    lengths, directions = edges_of(path)
    wide = np.concatenate([[0.0], blends, [0.0]])[:, None]
    starts, ends = path[:-1] + wide[:-1] * directions, path[1:] - wide[1:] * directions
    # Two blends that meet leave nothing between them but rounding.
    left = lengths - wide[:-1, 0] - wide[1:, 0] > 1e-12 * lengths.sum()
    return starts[left], ends[left]


def blend_chords(
    path: np.ndarray, corner: np.ndarray, blends: np.ndarray, pieces: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points of blends, and how far each joint of the curve is from their chords, at most.

    On a chord over a step h of s, a curve strays by h^2 / 8 of its second derivative at most.

    Args:
        path: `[L D]` without repetitions.
        corner: `[B]`, numbers from 1 of the corners in the path.
        blends: `[B]`, above 0.
        pieces: K chords a blend, an even number.

    Returns:
        `[B K+1 D]` points and `[B K D]` distances.
    """
    _, directions = edges_of(path)
    before, after = directions[corner - 1], directions[corner]
    w = np.linspace(0, 1, pieces + 1)[:, None]
    turn, width = (after - before)[:, None], 2 * blends[:, None, None]
    begin = path[corner] - blends[:, None] * before
    points = begin[:, None] + width * (w * before[:, None] + w**3 * (1 - w / 2) * turn)
    # 6 w (1 - w) is largest at the end that is nearer to the middle, the number being even.
    most = np.maximum(*(6 * x * (1 - x) for x in (w[:-1], w[1:])))
    return points, most * np.abs(turn) / width * (width / pieces) ** 2 / 8


def stray(path: np.ndarray, blends: np.ndarray) -> np.ndarray:
    """How far each corner `[L - 2]` of a path without repetitions is from the curve at most,
    configuration units."""
    _, directions = edges_of(path)
    return _STRAY * blends * np.linalg.norm(np.diff(directions, axis=0), axis=1)
