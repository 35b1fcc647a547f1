"""The fastest motion along a curve: TOPP-RA (Pham and Pham 2018) in closed form.

The path's acceleration u is constant on each interval of the grid, so that its squared speed x is
linear in s. A limit on an interval is a row `lower <= slope * u + bend * x <= upper` of u there and
x at its beginning. What is limited is a curve over the interval; rows bound the control points of
the parabola through its ends and middle, so that it is within its limits in between, too.

A pass from the end finds the squared speeds from which the end can be reached, another from the
start takes the largest u that stays among them. Each asks for the extreme of one variable of two.
For that the other is eliminated (Fourier-Motzkin): two rows leave one inequality of x. Nothing
is iterated, and rows without u need no case of their own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gnnjax.arm.robot import Robot
from gnnjax.trajectory.curve import Curve, Places, places, thirds
from gnnjax.trajectory.dynamics import path_dynamics
from gnnjax.trajectory.limits import Limits

_ROUNDING = 1e-10  # relative to the terms that cancel; the arithmetic is in double precision
_SLOWEST = 1e-18  # squared share of its limit that the fastest joint has at s = 1/s, at least


class Rows(NamedTuple):
    """R limits of each of N intervals."""

    slope: Float[Array, "R N"]  # of u; not negative where they are compared
    bend: Float[Array, "R N"]  # of x
    lower: Float[Array, "R N"]
    upper: Float[Array, "R N"]


class Timing(NamedTuple):
    """A motion along a curve."""

    x: Float[Array, "*batch N+1"]  # squared speed at grid points, 1/s^2 in units of s
    u: Float[Array, "*batch N"]  # acceleration between them
    times: Float[Array, "*batch N+1"]  # s
    failed_at: Int[Array, "*batch"]  # grid point from which nothing leads on; -1 when feasible


def fastest(robot: Robot, limits: Limits, curve: Curve) -> Timing:
    """The fastest motion from rest to rest along one curve, which rests at its stops."""
    steps = jnp.diff(curve.grid)
    count = 2 * len(steps) + 1
    dense = places(curve, jnp.arange(count) / 2)
    rows = _rows(robot, limits, dense, steps)
    low, high = _alone(rows)
    high = jnp.where(curve.stops == 1, 0.0, jnp.append(high, jnp.inf))
    low = jnp.maximum(jnp.append(low, 0.0), 0.0)
    if limits.jerk is not None:  # what a steady speed has of it, in blends alone
        at = jnp.arange(len(high), dtype=high.dtype)
        thrice = jnp.stack([thirds(curve, at + side) for side in (-1e-6, 1e-6)])
        most = (jnp.abs(thrice) / limits.jerk).max(axis=(0, 2))
        high = jnp.minimum(high, most ** (-2 / 3))  # infinite without
    return _passes(rows, steps, low, high)


def _rows(robot: Robot, limits: Limits, dense: Places, steps: jax.Array) -> Rows:
    """The limits on all intervals, three rows each: the control points."""
    slope, bend = dense.slope, dense.bend
    shares = (slope / limits.velocity) ** 2
    below, above = (jnp.broadcast_to(sign * limits.acceleration, slope.shape) for sign in (-1, 1))
    if limits.torque is not None:
        torques = path_dynamics(robot, *dense)
        # sqrt(x) is at most its tangent at a fourth of the largest x that velocities allow, and
        # at least that less a fourth of the largest root.
        root = jnp.sqrt(1 / jnp.maximum(shares.max(axis=-1, keepdims=True), _SLOWEST))
        viscous, dry = torques.damping, robot.mj_model.dof_frictionloss
        middle = torques.rest + viscous * root / 4
        least = middle - jnp.maximum(viscous, 0.0) * root / 4 - dry
        most = middle + jnp.maximum(-viscous, 0.0) * root / 4 + dry
        slope = jnp.concatenate([slope, torques.inertia], axis=-1)
        bend = jnp.concatenate([bend, torques.speed + viscous / root], axis=-1)
        below = jnp.concatenate([below, -limits.torque - least], axis=-1)
        above = jnp.concatenate([above, limits.torque - most], axis=-1)

    slope, bend, below, above = (
        jnp.stack([x[:-2:2], x[1::2], x[2::2]]) for x in (slope, bend, below, above)
    )  # [3 N K]
    # x has grown by 2 u times the way from the interval's beginning.
    slope = slope + jnp.stack([0 * steps, steps, 2 * steps])[..., None] * bend
    slope, bend, lower, upper = (
        jnp.moveaxis(_control(x), 1, 2).reshape(-1, len(steps)) for x in (slope, bend, below, above)
    )
    forces = Rows(slope, bend, lower, upper)
    speeds = _speed_rows(shares, steps)
    slope, bend, lower, upper = (jnp.concatenate(both) for both in zip(speeds, forces, strict=True))
    flip = slope < 0
    return Rows(
        jnp.abs(slope),
        jnp.where(flip, -bend, bend),
        jnp.where(flip, -upper, lower),
        jnp.where(flip, -lower, upper),
    )


def _speed_rows(shares: jax.Array, steps: jax.Array) -> Rows:
    """The velocities: `share * x <= 1`, of joints' squared shares `[2N+1 D]` of their limits.

    Slopes may be negative.
    """
    most, joint = (
        jnp.stack([x[:-2:2], x[1::2], x[2::2]])
        for x in (shares.max(axis=-1), shares.argmax(axis=-1))
    )
    # No parabola fits where another joint becomes the fastest, but none is faster there than at
    # one of the ends.
    most = jnp.where((joint == joint[:1]).all(axis=0), most, most.max(axis=0))
    rises = jnp.stack([0 * steps, steps, 2 * steps]) * most
    over = jnp.ones_like(most)
    return Rows(*(_control(x) for x in (rises, most, -over, over)))


def _control(values: jax.Array) -> jax.Array:
    """The control points of parabolas through `[3 ...]` values: begin, middle, end."""
    begin, middle, end = values
    return jnp.stack([begin, 2 * middle - (begin + end) / 2, end])


def _alone(rows: Rows) -> tuple[jax.Array, jax.Array]:
    """The least and largest x `[N]` that each interval's rows allow for some u; the least is above
    the largest where there is none."""

    count = len(rows.slope)
    twice = Rows(*(jnp.concatenate([x, x]) for x in rows))

    def against(shift: jax.Array, found: tuple[jax.Array, jax.Array]) -> tuple:
        other = Rows(*(jax.lax.dynamic_slice_in_dim(x, shift, count) for x in twice))
        # Both hold u between (lower - bend x) / slope and (upper - bend x) / slope: neither's least
        # is above the other's largest. Written without the division by slopes.
        bottom, top = _quotients(
            other.slope * rows.bend,
            rows.slope * other.bend,
            (other.slope * rows.lower, rows.slope * other.upper),
            (other.slope * rows.upper, rows.slope * other.lower),
        )
        return jnp.maximum(found[0], bottom.max(axis=0)), jnp.minimum(found[1], top.min(axis=0))

    nothing = jnp.full(rows.slope.shape[1:], jnp.inf)
    return jax.lax.fori_loop(1, count // 2 + 1, against, (-nothing, nothing))


def _quotients(
    ahead: jax.Array,
    back: jax.Array,
    least: tuple[jax.Array, jax.Array],
    most: tuple[jax.Array, jax.Array],
) -> tuple[jax.Array, jax.Array]:
    """What x is between where `(ahead - back) x` is between two differences, which rounding may
    have moved; -inf is above nothing where there is no such x."""
    rate = ahead - back
    none = jnp.abs(rate) <= _ROUNDING * (jnp.abs(ahead) + jnp.abs(back))
    low = least[0] - least[1] - _ROUNDING * (jnp.abs(least[0]) + jnp.abs(least[1]))
    high = most[0] - most[1] + _ROUNDING * (jnp.abs(most[0]) + jnp.abs(most[1]))
    by = 1 / jnp.where(none, 1.0, rate)
    first, second = low * by, high * by
    never = (low > 0) | (high < 0)
    bottom = jnp.where(none, -jnp.inf, jnp.minimum(first, second))
    return bottom, jnp.where(none, jnp.where(never, -jnp.inf, jnp.inf), jnp.maximum(first, second))


def _passes(rows: Rows, steps: jax.Array, low: jax.Array, high: jax.Array) -> Timing:
    """Both passes.

    Args:
        rows: of the intervals.
        steps: `[N]` their lengths.
        low: `[N+1]` least x at grid points by what holds there and on the interval behind.
        high: `[N+1]` largest x.
    """
    over_intervals = Rows(*(x.T for x in rows))

    def back(after: tuple, at: tuple) -> tuple[tuple, tuple]:
        """The squared speeds from which some u leads to those behind the interval."""
        least, most = after
        row, step, low, high = at
        # least <= x + 2 step u <= most, against each row.
        bottom, top = _quotients(
            row.slope,
            2 * step * row.bend,
            (row.slope * least, 2 * step * row.upper),
            (row.slope * most, 2 * step * row.lower),
        )
        low, high = jnp.maximum(low, bottom.max()), jnp.minimum(high, top.min())
        # A stop that lasts: nothing moves on an interval of no length.
        low, high = jnp.where(step > 0, low, least), jnp.where(step > 0, high, most)
        # What rounding took from a single point, it gets back.
        low = jnp.where(low <= high + _ROUNDING * (1 + jnp.abs(high)), jnp.minimum(low, high), low)
        return (low, high), (low, high)

    end = low[-1], high[-1]
    inputs = over_intervals, steps, low[:-1], high[:-1]
    _, (least, most) = jax.lax.scan(back, end, inputs, reverse=True)
    least, most = jnp.append(least, end[0]), jnp.append(most, end[1])

    def forth(x: jax.Array, at: tuple) -> tuple[jax.Array, tuple]:
        row, step, least, most = at
        has_u = row.slope > 1e-9
        u = jnp.where(has_u, (row.upper - row.bend * x) / jnp.where(has_u, row.slope, 1.0), jnp.inf)
        reached = jnp.clip(x + 2 * step * u.min(), jnp.maximum(least, 0.0), most)
        reached = jnp.where(step > 0, reached, x)
        u = jnp.where(step > 0, (reached - x) / jnp.where(step > 0, 2 * step, 1.0), 0.0)
        return reached, (reached, u)

    start = jnp.zeros_like(high[0])
    _, (x, u) = jax.lax.scan(forth, start, (over_intervals, steps, least[1:], most[1:]))
    x = jnp.append(start, x)
    speeds = jnp.sqrt(x[:-1]) + jnp.sqrt(x[1:])
    moves = steps > 0
    spans = jnp.where(moves, 2 * steps / jnp.where(speeds > 0, speeds, 1.0), 0.0)
    # The last point from which nothing leads on comes first in the backward pass. Rest is
    # where the motion begins, and where it stays is no motion.
    empty = ~(least <= most) | (least > _ROUNDING) & (jnp.arange(len(x)) == 0)
    stuck = jnp.append(moves & ~(speeds > 0), False)
    index = jnp.arange(len(x))
    failed = jnp.where(
        empty.any(),
        jnp.max(jnp.where(empty, index, -1)),
        jnp.where(stuck.any(), jnp.argmax(stuck), -1),
    )
    return Timing(x, u, jnp.append(start, jnp.cumsum(spans)), failed)
