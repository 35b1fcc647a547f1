"""Motions whose joints have limited jerk, too.

The accelerations of the fastest motion leap. So its speed along the curve is averaged over a window
of time: then they do not, and the path's jerk is what leaps over the window's length (Biagiotti and
Melchiorri 2012). The arm stays on its curve, and rests where it did, since each stretch between two
stops is averaged by itself. What averaging takes beyond a limit is brought back by slowing down the
stretch as a whole (Hollerbach 1984): by a factor f, velocities go down by f, accelerations and
what torques have beyond those of rest by f^2, and jerks by f^3. Of all windows the one is taken
with which the stretch is over first.

Limits are compared at places whose distance is a fraction of an interval of the grid, on either
side of each leap of the jerk. On straight lines, where the shortest motion is known, this one takes
no longer where a velocity is reached for as long as the window is, and up to a fifth longer where
it is not.
"""

import itertools
from typing import NamedTuple

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.trajectory.curve import Curve, places, thirds
from gnnjax.trajectory.dynamics import inverse_dynamics_by_mujoco
from gnnjax.trajectory.limits import Limits
from gnnjax.trajectory.timing import Timing

_PARTS = np.linspace(0, 1, 5)  # of a piece, at which limits are compared
_WINDOWS = 2.0 ** np.arange(-5, 1.6, 0.5)  # that are tried, shares of one that surely suffices


class Profile(NamedTuple):
    """A way s along a curve over time, cubic in K pieces."""

    times: np.ndarray  # [K+1] s
    way: np.ndarray  # [K] at the beginning of each, configuration units
    speed: np.ndarray  # [K] units/s
    push: np.ndarray  # [K] units/s^2
    jerk: np.ndarray  # [K] units/s^3

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Way, speed and push at times `[T]`."""
        piece = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.way) - 1)
        return self.after(piece, times - self.times[piece])

    def after(
        self, piece: np.ndarray, since: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same in pieces, a time after their beginning."""
        s, v, a, j = (x[piece] for x in self[1:])
        way = s + since * (v + since * (a / 2 + since * j / 6))
        return way, v + since * (a + since * j / 2), a + since * j

    def slowed(self, factor: float) -> "Profile":
        """The same way, slower."""
        powers = (-1, 0, 1, 2, 3)
        return Profile(*(x / factor**n for x, n in zip(self, powers, strict=True)))


class _Needs(NamedTuple):
    """Torques at P places of a curve, N m or N."""

    rest: np.ndarray  # [P D]
    push: np.ndarray  # [P D] of each unit/s^2
    speed: np.ndarray  # [P D] of each unit^2/s^2
    damping: np.ndarray  # [P D] of each unit/s
    dry: np.ndarray  # [P D] while it moves


def limit_jerk(robot: Robot, limits: Limits, curve: Curve, timing: Timing) -> Profile | None:
    """A motion along a curve within all limits, jerk included, from the fastest one without; None
    where slowing down does not bring it there: torques do not suffice to be slow."""
    halves = np.arange(2 * len(curve.grid) - 1) / 2
    needs = None if limits.torque is None else _needs(robot, curve, halves)
    stops, found = np.flatnonzero(curve.stops), []
    for first, last in itertools.pairwise(stops.tolist()):
        if curve.grid[last] == curve.grid[first]:
            continue
        profile = _stretch(robot, limits, curve, timing, needs, first, last)
        if profile is None:
            return None
        found.append(profile)
    if not found:  # nothing moves
        return Profile(np.zeros(2), *np.zeros((4, 1)))
    starts = np.cumsum([0.0, *(x.times[-1] for x in found)])
    times = [x.times[:-1] + start for x, start in zip(found, starts[:-1], strict=True)]
    pieces = (np.concatenate([x[n] for x in found]) for n in range(1, 5))
    return Profile(np.concatenate([*times, starts[-1:]]), *pieces)


def _stretch(
    robot: Robot,
    limits: Limits,
    curve: Curve,
    timing: Timing,
    needs: _Needs | None,
    first: int,
    last: int,
) -> Profile | None:
    """The motion between two stops, at grid points."""
    inside = slice(first, last)
    times = timing.times[first : last + 1] - timing.times[first]
    pushes = timing.u[inside]
    slopes = places(curve, np.arange(first, last) + 0.5).slope
    steepest = (np.abs(slopes) / limits.jerk).max()
    enough = float(steepest * (max(pushes.max(), 0.0) - min(pushes.min(), 0.0)))

    def tried(window: float) -> tuple[float, float, Profile]:
        profile = _averaged(times, timing.x[first : last + 1], pushes, window)
        profile = profile._replace(way=profile.way + curve.grid[first])
        factor = _factor(limits, curve, needs, *_samples(curve, profile, first, last))
        return factor * profile.times[-1], factor, profile

    _, factor, profile = min((tried(enough * share) for share in _WINDOWS), key=lambda x: x[0])
    if not np.isfinite(factor):
        return None
    profile = profile.slowed(factor)
    if needs is None:
        return profile
    # Torques were read between points of the grid; here they are what they are.
    at, speed, push, _ = _samples(curve, profile, first, last)
    place, v, a = places(curve, at), speed[:, None], push[:, None]
    moved = place.q, place.slope * v, place.slope * a + place.bend * v**2
    if (np.abs(inverse_dynamics_by_mujoco(robot, *moved)) <= limits.torque).all():
        return profile
    exact = _torque_factor(limits, _needs(robot, curve, at), speed, push)
    return profile.slowed(max(1.0, exact)) if np.isfinite(exact) else None


def _averaged(times: np.ndarray, x: np.ndarray, pushes: np.ndarray, window: float) -> Profile:
    """The motion with constant pushes between times whose speed is the mean over a window before.

    Args:
        times: `[M+1]` s, from 0.
        x: `[M+1]` squared speeds, 0 at both ends.
        pushes: `[M]`.
        window: s.
    """
    speeds = np.sqrt(x)
    steps = np.diff(times)
    ways = np.concatenate([[0.0], np.cumsum(steps * (speeds[1:] + speeds[:-1]) / 2)])

    def before(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Way, speed and push of the motion."""
        row = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(steps) - 1)
        since = np.clip(at - times[row], 0.0, steps[row])
        moving = (at > 0) & (at < times[-1])
        way = ways[row] + since * (speeds[row] + since * pushes[row] / 2)
        speed = speeds[row] + since * pushes[row]
        return way, np.where(moving, speed, 0.0), np.where(moving, pushes[row], 0.0)

    cuts = np.union1d(times, times + window)
    middles = (cuts[1:] + cuts[:-1]) / 2
    way, speed, _ = (
        (now - then) / window for now, then in zip(before(cuts), before(cuts - window), strict=True)
    )
    leaps = before(middles)[2] - before(middles - window)[2]
    v, a, j, lasts = way[:-1], speed[:-1], leaps / window, np.diff(cuts)
    gone = np.cumsum(lasts * (v + lasts * (a / 2 + lasts * j / 6)))
    return Profile(cuts, np.concatenate([[0.0], gone[:-1]]), v, a, j)


def _samples(
    curve: Curve, profile: Profile, first: int, last: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where limits are compared: grid indices, speeds, pushes and jerks."""
    piece = np.repeat(np.arange(len(profile.way)), len(_PARTS))
    since = (np.diff(profile.times)[:, None] * _PARTS).ravel()
    way, _, _ = profile.after(piece, since)
    # Where blends begin and end, the third derivative leaps.
    ends = np.stack([curve.entries, curve.exits])[:, curve.blends > 0].ravel()
    ends = curve.grid[ends[(ends >= first) & (ends <= last)]]
    when = np.interp(ends, np.maximum.accumulate(way), profile.times[piece] + since)
    more = np.clip(np.searchsorted(profile.times, when, side="right") - 1, 0, len(profile.way) - 1)
    piece = np.concatenate([piece, more])
    since = np.concatenate([since, when - profile.times[more]])
    way, speed, push = profile.after(piece, since)
    way = np.concatenate([way[: -len(ends) or None], ends])
    at = np.interp(way, curve.grid[first : last + 1], np.arange(first, last + 1))
    return at, np.maximum(speed, 0.0), push, profile.jerk[piece]


def _factor(
    limits: Limits,
    curve: Curve,
    needs: _Needs | None,
    at: np.ndarray,
    speed: np.ndarray,
    push: np.ndarray,
    jerk: np.ndarray,
) -> float:
    """By how much a motion has to be slowed down for all limits to hold; inf where that is in
    vain."""
    place = places(curve, at)
    v, a, j = (x[:, None] for x in (speed, push, jerk))
    steady = 3 * place.bend * v * a + place.slope * j
    jerks = np.stack([thirds(curve, at + side) * v**3 + steady for side in (-1e-9, 1e-9)])
    factors = [
        np.abs(place.slope * v / limits.velocity).max(),
        np.abs((place.slope * a + place.bend * v**2) / limits.acceleration).max() ** (1 / 2),
        np.abs(jerks / limits.jerk).max() ** (1 / 3),
    ]
    if needs is not None:
        near = np.clip(2 * at, 0, len(needs.rest) - 1)
        low = np.minimum(near.astype(int), len(needs.rest) - 2)
        share = (near - low)[:, None]
        between = _Needs(*((1 - share) * x[low] + share * x[low + 1] for x in needs))
        factors.append(_torque_factor(limits, between, speed, push))
    return max(1.0, *(float(x) for x in factors))


def _torque_factor(limits: Limits, needs: _Needs, speed: np.ndarray, push: np.ndarray) -> float:
    """The least f >= 0 from which on torques, `rest + linear / f + square / f^2`, keep limits."""
    v, a = speed[:, None], push[:, None]
    rest, linear = needs.rest + np.sign(v) * needs.dry, needs.damping * v
    square, most = needs.push * a + needs.speed * v**2, 0.0
    for sign in (-1, 1):
        left, slope, bend = sign * rest - limits.torque, sign * linear, sign * square
        if (left >= 0).any():
            return np.inf
        # The first positive root of left + slope m + bend m^2, m = 1 / f.
        under = slope**2 - 4 * bend * left
        by = slope + np.sqrt(np.maximum(under, 0.0))
        f = np.where((under >= 0) & (by > 0), by / (-2 * left), 0.0)
        most = max(most, float(f.max()))
    return most


def _needs(robot: Robot, curve: Curve, at: np.ndarray) -> _Needs:
    """Torques at grid indices `[P]`, by MuJoCo's inverse dynamics."""
    place = places(curve, at)
    still, model = np.zeros_like(place.q), robot.mj_model
    dry, damping = model.dof_frictionloss * np.sign(place.slope), model.dof_damping * place.slope
    rest = inverse_dynamics_by_mujoco(robot, place.q, still, still)
    push = inverse_dynamics_by_mujoco(robot, place.q, still, place.slope)
    speed = inverse_dynamics_by_mujoco(robot, place.q, place.slope, place.bend)
    return _Needs(rest, push - rest, speed - rest - dry - damping, damping, dry)
