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
it is not but the acceleration is. Where jerk is so low that neither would be, it takes up to three
times as long.

A stretch is a curve of its own, of one of few sizes, so that there are few shapes to compile.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.arm.robot import Robot
from gnnjax.clock import Clock
from gnnjax.trajectory.batches import over_curves
from gnnjax.trajectory.curve import Curve, cut, places, thirds
from gnnjax.trajectory.limits import Limits
from gnnjax.trajectory.needs import Needs, needs_of
from gnnjax.trajectory.timing import Timing

_PARTS = np.linspace(0, 1, 5)  # of a piece, at which limits are compared
_NEWTON = 4  # steps, to when a place is reached
_WINDOWS = 2.0 ** np.arange(-5, 1.6, 0.5)  # that are tried, shares of one that surely suffices


class Profile(NamedTuple):
    """A way s along a curve over time, cubic in K pieces."""

    times: Float[Array | np.ndarray, "*batch K+1"]  # s
    way: Float[Array | np.ndarray, "*batch K"]  # at the beginning of each, configuration units
    speed: Float[Array | np.ndarray, "*batch K"]  # units/s
    push: Float[Array | np.ndarray, "*batch K"]  # units/s^2
    jerk: Float[Array | np.ndarray, "*batch K"]  # units/s^3

    def at(self, times: np.ndarray) -> tuple[Any, Any, Any]:
        """Way, speed and push at times `[T]`."""
        piece = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.way) - 1)
        return self.after(piece, times - self.times[piece])

    def after(self, piece: Any, since: Any) -> tuple[Any, Any, Any]:
        """The same in pieces, a time after their beginning."""
        s, v, a, j = (x[piece] for x in self[1:])
        way = s + since * (v + since * (a / 2 + since * j / 6))
        return way, v + since * (a + since * j / 2), a + since * j

    def slowed(self, factor: Any) -> "Profile":
        """The same way, slower."""
        powers = (-1, 0, 1, 2, 3)
        return Profile(*(x / factor**n for x, n in zip(self, powers, strict=True)))


class _Stretch(NamedTuple):
    """What is between two stops. Of the grid's padding, nothing takes time."""

    curve: Curve
    timing: Timing
    needs: Needs | None  # at all halves of intervals; None: torques have no limits


class _Samples(NamedTuple):
    """Where limits are compared."""

    at: Float[Array, "*batch P"]  # grid index
    speed: Float[Array, "*batch P"]
    push: Float[Array, "*batch P"]
    jerk: Float[Array, "*batch P"]
    exists: Bool[Array, "*batch P"]  # false in pieces that take no time


class _Slower(NamedTuple):
    """A motion along a stretch, from time zero on."""

    profile: Profile  # with pieces that take no time
    samples: _Samples
    factor: Float[Array, "*batch"]  # by which it has been slowed down; inf: in vain


def limit_jerk(
    robot: Robot,
    limits: Limits,
    curves: Sequence[Curve],
    timings: Sequence[Timing],
    wanted: Sequence[bool],
    clock: Clock,
) -> list[Profile | None]:
    """Motions along curves within all limits, jerk included, from the fastest ones without.

    None where one is not wanted, or jerk has no limits; and where slowing down does not bring it
    there: torques do not suffice to be slow.
    """
    found: list[Profile | None] = [None] * len(curves)
    chosen = [] if limits.jerk is None else np.flatnonzero(wanted).tolist()
    if not chosen:
        return found
    needs: list[Needs | None] = [None] * len(chosen)
    if limits.torque is not None:
        halves = [np.arange(2 * len(curves[i].grid) - 1) / 2 for i in chosen]
        needs = [*needs_of(robot, [curves[i] for i in chosen], halves, clock)]
    owners, begins, stretches = [], [], []
    for i, need in zip(chosen, needs, strict=True):
        curve = curves[i]
        for first, last in itertools.pairwise(np.flatnonzero(curve.stops).tolist()):
            if curve.grid[last] > curve.grid[first]:
                owners.append(i)
                begins.append(curve.grid[first])
                stretches.append(_stretch(curve, timings[i], need, first, last))
    sizes = [len(each.curve.grid) for each in stretches]
    slower = over_curves(_alone, _together, limits, stretches, sizes, clock)
    parts: dict[int, list[Profile | None]] = {i: [] for i in chosen}
    factors = _exact_factors(robot, limits, [each.curve for each in stretches], slower, clock)
    for i, begin, each, factor in zip(owners, begins, slower, factors, strict=True):
        part = each.profile._replace(way=each.profile.way + begin).slowed(factor)
        parts[i].append(part if np.isfinite(factor) else None)
    for i in chosen:
        found[i] = _joined(parts[i])
    return found


def _stretch(curve: Curve, timing: Timing, needs: Needs | None, first: int, last: int) -> _Stretch:
    """What is between two grid points."""
    own = cut(curve, first, last)
    points = np.minimum(first + np.arange(len(own.grid)), last)
    x, times = timing.x[points], timing.times[points]
    u = timing.u[np.minimum(points[:-1], last - 1)]
    if needs is not None:
        halves = np.minimum(2 * first + np.arange(2 * len(own.grid) - 1), 2 * last)
        needs = Needs(*(values[halves] for values in needs))
    return _Stretch(own, Timing(x, u, times - times[0], timing.failed_at), needs)


def _joined(parts: Sequence[Profile | None]) -> Profile | None:
    """One motion after the other, without the pieces that take no time."""
    if not parts:  # nothing moves
        return Profile(np.zeros(2), *np.zeros((4, 1)))
    whole = [part for part in parts if part is not None]
    if len(whole) < len(parts):
        return None
    starts = np.cumsum([0.0, *(float(part.times[-1]) for part in whole)])
    left = [np.diff(part.times) > 0 for part in whole]
    times = [
        part.times[:-1][some] + start
        for part, some, start in zip(whole, left, starts[:-1], strict=True)
    ]
    pieces = (
        np.concatenate([part[n][some] for part, some in zip(whole, left, strict=True)])
        for n in range(1, 5)
    )
    return Profile(np.concatenate([*times, starts[-1:]]), *pieces)


def _slower(limits: Limits, stretch: _Stretch) -> _Slower:
    """The motion along one stretch; torques are read between points of the grid."""
    curve, timing, needs = stretch
    assert limits.jerk is not None
    slopes = places(curve, jnp.arange(len(timing.u)) + 0.5).slope
    enough = jnp.max(jnp.abs(slopes) / limits.jerk) * jnp.ptp(timing.u)

    def tried(window: jax.Array) -> _Slower:
        profile = _averaged(timing.times, timing.x, timing.u, window)
        samples = _samples(curve, profile)
        return _Slower(profile, samples, _factor(limits, curve, needs, samples))

    windows = enough * _WINDOWS
    factors = jax.lax.map(lambda window: tried(window).factor, windows)
    best = tried(windows[jnp.argmin(factors * (timing.times[-1] + windows))])
    factor, (at, speed, push, jerk, exists) = best.factor, best.samples
    slow = _Samples(at, speed / factor, push / factor**2, jerk / factor**3, exists)
    return _Slower(best.profile.slowed(factor), slow, factor)


_alone = jax.jit(_slower)
_together = jax.jit(jax.vmap(_slower, in_axes=(None, 0)))


def _averaged(
    times: Float[Array, " P"], x: Float[Array, " P"], pushes: Float[Array, " N"], window: jax.Array
) -> Profile:
    """The motion with constant pushes between times whose speed is the mean over a window before.

    Args:
        times: s, from 0; P = N + 1.
        x: squared speeds, 0 at both ends.
        pushes: between times.
        window: s.
    """
    speeds, steps = jnp.sqrt(x), jnp.diff(times)
    ways = jnp.append(0.0, jnp.cumsum(steps * (speeds[1:] + speeds[:-1]) / 2))

    def before(at: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Way, speed and push of the motion."""
        row = jnp.clip(jnp.searchsorted(times, at, side="right") - 1, 0, len(steps) - 1)
        since = jnp.clip(at - times[row], 0.0, steps[row])
        moving = (at > 0) & (at < times[-1])
        way = ways[row] + since * (speeds[row] + since * pushes[row] / 2)
        speed = speeds[row] + since * pushes[row]
        return way, jnp.where(moving, speed, 0.0), jnp.where(moving, pushes[row], 0.0)

    cuts = jnp.sort(jnp.concatenate([times, times + window]))
    middles = (cuts[1:] + cuts[:-1]) / 2
    way, speed, _ = (
        (now - then) / window for now, then in zip(before(cuts), before(cuts - window), strict=True)
    )
    leaps = before(middles)[2] - before(middles - window)[2]
    v, a, j, lasts = way[:-1], speed[:-1], leaps / window, jnp.diff(cuts)
    gone = jnp.cumsum(lasts * (v + lasts * (a / 2 + lasts * j / 6)))
    return Profile(cuts, jnp.append(0.0, gone[:-1]), v, a, j)


def _samples(curve: Curve, profile: Profile) -> _Samples:
    steps = jnp.diff(profile.times)
    piece = jnp.repeat(jnp.arange(len(steps)), len(_PARTS))
    since = (steps[:, None] * _PARTS).ravel()
    way, _, _ = profile.after(piece, since)
    # Where blends begin and end, the third derivative leaps; short ones may lie within a piece, and
    # bend most in their middles. They are at grid points.
    when = jnp.interp(curve.grid, jax.lax.cummax(way), profile.times[piece] + since)
    more = jnp.clip(jnp.searchsorted(profile.times, when, side="right") - 1, 0, len(steps) - 1)
    there = when - profile.times[more]
    for _ in range(_NEWTON):
        gone, pace, _ = profile.after(more, there)
        there += (curve.grid - gone) / jnp.where(pace > 0, pace, jnp.inf)
        there = jnp.clip(there, 0.0, steps[more])
    piece, since = jnp.concatenate([piece, more]), jnp.concatenate([since, there])
    _, speed, push = profile.after(piece, since)
    at = jnp.interp(way, curve.grid, jnp.arange(len(curve.grid)))
    at = jnp.append(at, jnp.arange(len(curve.grid)))
    return _Samples(at, jnp.maximum(speed, 0.0), push, profile.jerk[piece], steps[piece] > 0)


def _factor(limits: Limits, curve: Curve, needs: Needs | None, samples: _Samples) -> jax.Array:
    """By how much a motion has to be slowed down for all limits to hold; inf where that is in
    vain."""
    assert limits.jerk is not None
    at, exists = samples.at, samples.exists[:, None]
    place = places(curve, at)
    v, a, j = (x[:, None] for x in samples[1:4])
    steady = 3 * place.bend * v * a + place.slope * j
    jerks = jnp.stack([thirds(curve, at + side) * v**3 + steady for side in (-1e-9, 1e-9)])

    def most(values: jax.Array) -> jax.Array:
        return jnp.max(jnp.abs(values), where=exists, initial=0.0)

    factor = jnp.maximum(1.0, most(place.slope * v / limits.velocity))
    pushes = (place.slope * a + place.bend * v**2) / limits.acceleration
    factor = jnp.maximum(factor, most(pushes) ** (1 / 2))
    factor = jnp.maximum(factor, most(jerks / limits.jerk) ** (1 / 3))
    if needs is None:
        return factor
    near = jnp.clip(2 * at, 0, len(needs.rest) - 1)
    low = jnp.minimum(near.astype(int), len(needs.rest) - 2)
    share = (near - low)[:, None]
    between = Needs(*((1 - share) * x[low] + share * x[low + 1] for x in needs))
    return jnp.maximum(factor, _torque_factor(limits, between, samples))


def _torque_factor(limits: Limits, needs: Needs, samples: _Samples) -> jax.Array | np.floating:
    """The least f >= 0 from which on torques, `rest + linear / f + square / f^2`, keep limits."""
    v, a = samples.speed[:, None], samples.push[:, None]
    xp = v.__array_namespace__()
    rest, linear = needs.rest + xp.sign(v) * needs.dry, needs.damping * v
    square, most = needs.push * a + needs.speed * v**2, 0.0
    for sign in (-1, 1):
        left, slope, bend = sign * rest - limits.torque, sign * linear, sign * square
        # The first positive root of left + slope m + bend m^2, m = 1 / f.
        under = slope**2 - 4 * bend * left
        by = slope + xp.sqrt(xp.maximum(under, 0.0))
        f = xp.where((under >= 0) & (by > 0), by / (-2 * xp.minimum(left, -1e-300)), 0.0)
        f = xp.where(left >= 0, xp.inf, f)
        most = xp.maximum(most, xp.max(xp.where(samples.exists[:, None], f, 0.0)))
    return most


def _exact_factors(
    robot: Robot, limits: Limits, curves: list[Curve], found: list[_Slower], clock: Clock
) -> list[float]:
    """By how much motions have to be slowed down once more, torques being what they are, not what
    they are between points of the grid; inf where that, or what was before, is in vain."""
    factors = [1.0 if np.isfinite(slower.factor) else np.inf for slower in found]
    if limits.torque is None or not found:
        return factors
    left = [_Samples(*(x[each.samples.exists] for x in each.samples)) for each in found]
    needs = needs_of(robot, curves, [samples.at for samples in left], clock)
    for i, (need, samples) in enumerate(zip(needs, left, strict=True)):
        v, a = samples.speed[:, None], samples.push[:, None]
        torques = need.rest + need.push * a + need.speed * v**2
        torques += need.damping * v + np.sign(v) * need.dry
        if (np.abs(torques) > limits.torque).any():
            factors[i] = max(factors[i], float(_torque_factor(limits, need, samples)))
    return factors
