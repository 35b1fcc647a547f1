"""Motions along rounded paths, which stop at corners where that takes less time.

Where jerk is limited, it is a stretch between stops that is slowed down as a whole, and a corner
that is hardly rounded, as between points that are almost the same, would slow down all of it. So
motions are found that stop at no corner, at the narrowest and at less narrow ones, too. Stretches
of any of them that follow each other are a motion, and that of the fastest ones is it.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.clock import Clock
from gnnjax.devices import cache_compilations
from gnnjax.trajectory.batches import over_curves
from gnnjax.trajectory.curve import Curve, edges_of, make_curve, size_of
from gnnjax.trajectory.jerk import Profile, limit_jerk
from gnnjax.trajectory.limits import Limits
from gnnjax.trajectory.smooth import Smoothed
from gnnjax.trajectory.timing import Timing, fastest

# A corner is narrow if it is passed more slowly than so many times the square of a joint's
# acceleration by its jerk: about what is gained while acceleration builds up.
_NARROW = 0.35, 1.0, 1.8, 2.0


class Move(NamedTuple):
    """What a trajectory is made of."""

    smooth: Smoothed
    curve: Curve
    timing: Timing
    profile: Profile | None

    @property
    def moving(self) -> bool:
        """Whether there is a motion, jerk left aside."""
        return self.smooth.certified and int(self.timing.failed_at) < 0

    @property
    def lasts(self) -> float:
        """Seconds of the motion of limited jerk; inf without."""
        return np.inf if self.profile is None else float(self.profile.times[-1])


def find_moves(
    robot: Robot, limits: Limits, smoothed: Sequence[Smoothed], clock: Clock
) -> list[Move]:
    """The fastest motions along rounded paths."""
    moves = _moves(robot, limits, smoothed, clock)
    if limits.jerk is None:
        return moves
    tried = [[move] for move in moves]
    for propose in (functools.partial(_narrow_stops, limits), _best_stops):
        proposed = [propose(own) for own in tried]
        found = iter(_moves(robot, limits, [x for own in proposed for x in own], clock))
        for own, those in zip(tried, proposed, strict=True):
            own += itertools.islice(found, len(those))
    return [min(own, key=lambda move: move.lasts) for own in tried]


def _moves(robot: Robot, limits: Limits, smoothed: Sequence[Smoothed], clock: Clock) -> list[Move]:
    """Those that stop at no other corners."""
    if not smoothed:
        return []
    curves = [make_curve(x.path, x.blends, size_of(x.path)) for x in smoothed]
    timings = _timed(robot, limits, curves, clock)
    moves = [Move(*each, None) for each in zip(smoothed, curves, timings, strict=True)]
    moving = [move.moving for move in moves]
    profiles = limit_jerk(robot, limits, curves, timings, moving, clock)
    return [move._replace(profile=each) for move, each in zip(moves, profiles, strict=True)]


def _timed(robot: Robot, limits: Limits, curves: list[Curve], clock: Clock) -> list[Timing]:
    """The fastest motions along curves, which are of several sizes."""
    cache_compilations()
    if limits.jerk is None:  # the same program
        limits = limits._replace(jerk=np.full(robot.num_dof, np.inf))
    # Single precision loses what cancels where a row hardly depends on u.
    sizes = [len(curve.grid) for curve in curves]
    return over_curves(*_compiled(robot), limits, curves, sizes, clock)


@functools.cache
def _compiled(robot: Robot) -> tuple[Callable, Callable]:
    """`fastest` for one curve and for many."""
    run = functools.partial(fastest, robot)
    return jax.jit(run), jax.jit(jax.vmap(run, in_axes=(None, 0)))


def _narrow_stops(limits: Limits, moves: list[Move]) -> list[Smoothed]:
    """The path of a motion with stops at the corners that are rounded, and narrow, by each
    measure."""
    (move,) = moves
    path, blends, _ = move.smooth
    if not (move.moving and blends.any()):
        return []
    assert limits.jerk is not None
    slopes = np.maximum(np.abs(edges_of(path)[1]), 1e-12)
    push, jerk = ((x / slopes).min(axis=1) for x in (limits.acceleration, limits.jerk))
    gained = push**2 / jerk  # of the speed along each edge
    middles = (move.curve.entries + move.curve.exits)[: len(blends)] // 2
    speeds = np.sqrt(move.timing.x[middles]) / np.maximum(gained[:-1], gained[1:])
    return _with_stops(moves, [(speeds < most) & (blends > 0) for most in _NARROW])


def _with_stops(moves: list[Move], masks: list[np.ndarray]) -> list[Smoothed]:
    """The path of some motions with more stops, at masks `[L - 2]` of corners, as far as that is
    new."""
    found, known = [], [move.smooth.blends for move in moves]
    for mask in masks:
        blends = np.where(mask, 0.0, known[0])
        if not any((blends == own).all() for own in known):
            known.append(blends)
            found.append(moves[0].smooth._replace(blends=blends))
    return found


def _best_stops(moves: list[Move]) -> list[Smoothed]:
    """The path of some motions with the stops between which one of them each takes the least
    time."""
    lasts: dict[tuple[int, int], float] = {}
    for move in moves:
        for ends, time in _stretches(move):
            lasts[ends] = min(time, lasts.get(ends, np.inf))
    # The shortest way from the start, 0, to the goal. Of a corner it is known before it is used,
    # as all stretches lead ahead.
    goal = len(moves[0].smooth.blends) + 1
    ways: dict[int, tuple[float, list[int]]] = {0: (0.0, [])}
    for (begin, end), time in sorted(lasts.items(), key=lambda item: item[0][1]):
        before, stops = ways[begin]
        if end not in ways or before + time < ways[end][0]:
            ways[end] = before + time, [*stops, end]
    mask = np.zeros(goal, bool)
    mask[[stop - 1 for stop in ways.get(goal, (0.0, []))[1]]] = True
    return _with_stops(moves, [mask[:-1]])


def _stretches(move: Move) -> list[tuple[tuple[int, int], float]]:
    """The stretches of a motion, each from one number of a configuration of the path to another,
    and how long each takes, s; none where jerk has no motion."""
    if move.profile is None:
        return []
    stops = np.flatnonzero(move.smooth.blends == 0)
    begins = np.searchsorted(move.profile.way, move.curve.corners[stops] - 1e-9)
    times = [0.0, *move.profile.times[begins].tolist(), move.lasts]
    numbers = [0, *(stops + 1).tolist(), len(move.smooth.blends) + 1]
    return [*zip(itertools.pairwise(numbers), np.diff(times).tolist(), strict=True)]
