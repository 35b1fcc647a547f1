"""States along a motion: positions, velocities, accelerations and torques at times."""

from typing import Any, NamedTuple

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import inverse_dynamics_by_mujoco
from gnnjax.collision.certify import beyond_limits
from gnnjax.errors import InputError, check_number
from gnnjax.trajectory.curve import Curve, places
from gnnjax.trajectory.jerk import Profile
from gnnjax.trajectory.limits import Limits
from gnnjax.trajectory.timing import Timing
from gnnjax.trajectory.trajectory import Trajectory

_DENSER = 10  # moments for each interval of a motion's own, at which its limits are compared
_SHORTEST = 1e-6  # s; a last step is no shorter
_SOONEST = 1e-7  # s, between accelerations whose difference is no rounding
_ROUNDED = 1e-3  # rad or m, of joint limits: people round what they write


class Setpoints(NamedTuple):
    """States at T times of a motion."""

    times: np.ndarray  # [T] s
    positions: np.ndarray  # [T D] rad or m
    velocities: np.ndarray  # [T D] rad/s or m/s
    accelerations: np.ndarray  # [T D] rad/s^2 or m/s^2
    torques: np.ndarray  # [T D] N m or N, of motors, without contacts


def sample_trajectory(robot: Robot, trajectory: Trajectory, dt: float) -> Setpoints:
    """States of a motion every `dt` seconds, and at its end.

    They are exact: how much accelerations differ from one to the next, by the time between them, is
    within a limit of jerk. The last step may be shorter than `dt`. Torques are those of MuJoCo's
    inverse dynamics, without contacts, and of dry friction.

    Raises:
        InputError: no motion, or a step that is none.
    """
    check_step(dt)
    return states(robot, trajectory, sample_times(trajectory, dt))


def sample_times(trajectory: Trajectory, dt: float) -> np.ndarray:
    """Times `[T]` every `dt` seconds of a motion, and its end.

    Raises:
        InputError: no motion.
    """
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"a {type(trajectory).__name__} is no motion; give plan.trajectory")
    if not trajectory.success:
        raise InputError(f"there is no motion to sample: {trajectory.reason}")
    # The last step may be that much longer, and none is as short that files round it away.
    count = int(np.ceil((trajectory.duration - _SHORTEST) / dt))
    if trajectory.duration > 0:
        count = max(1, count)
    return np.append(np.arange(count) * dt, trajectory.duration)


def states(robot: Robot, trajectory: Trajectory, times: np.ndarray) -> Setpoints:
    """States of a motion at times `[T]` from 0 to its duration."""
    moved = movement(trajectory, times)
    return Setpoints(times, *moved, inverse_dynamics_by_mujoco(robot, *moved))


def movement(
    trajectory: Trajectory, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and accelerations `[T D]` of a motion at such times."""
    curve, profile = trajectory.curve, trajectory.profile
    if profile is None:
        at, speed, push = _places_at(curve, trajectory.timing, times)
    else:
        way, speed, push = profile.at(times)
        at = np.interp(way, curve.grid, np.arange(len(curve.grid)))
        # Some microseconds around a stop, the way is the stop's up to rounding: the arm would be
        # on one side of its corner while it still accelerates on the other.
        at = np.clip(at, *_stretches_at(curve, profile, times))
    speed = np.maximum(speed, 0.0)[:, None]
    place = places(curve, at)
    positions = np.asarray(place.q)
    velocities = np.asarray(place.slope) * speed
    accelerations = np.asarray(place.slope * push[:, None] + place.bend * speed**2)
    return positions, velocities, accelerations


def largest_use(robot: Robot, limits: Limits, trajectory: Trajectory) -> float:
    """The largest share of any of its limits that a motion uses, seen between the moments of its
    grid, too: 1 where one is just reached.

    Torques are those of MuJoCo's inverse dynamics. Jerk, if limited, is how fast accelerations
    change from one moment to the next.
    """
    grid = np.asarray((trajectory.profile or trajectory.timing).times)
    grid = np.unique(grid[np.isfinite(grid)])
    times = np.linspace(grid[:-1], grid[1:], _DENSER, endpoint=False, axis=1).ravel()
    seen = states(robot, trajectory, np.append(times, grid[-1]))
    uses = [(seen.velocities, limits.velocity), (seen.accelerations, limits.acceleration)]
    if limits.torque is not None:
        uses.append((seen.torques, limits.torque))
    if limits.jerk is not None:
        steps = np.diff(seen.times)[:, None]
        leaps = np.where(steps > _SOONEST, np.diff(seen.accelerations, axis=0) / steps, 0.0)
        uses.append((leaps, limits.jerk))
    return max(float(np.max(np.abs(values) / most, initial=0.0)) for values, most in uses)


def _places_at(
    curve: Curve, timing: Timing, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grid indices, speeds and pushes `[T]` of the fastest motion."""
    steps = np.diff(curve.grid)
    # Intervals of no length take no time, and none begins at a time that another one has.
    interval = np.searchsorted(timing.times, times, side="right") - 1
    last = np.flatnonzero(steps > 0)[-1] if (steps > 0).any() else 0
    interval = np.minimum(interval, last)
    since = times - timing.times[interval]
    begin, u = np.sqrt(timing.x[interval]), np.asarray(timing.u[interval])
    step = steps[interval]
    way = np.clip(begin * since + u * since**2 / 2, 0.0, step)
    at = interval + np.divide(way, step, out=np.zeros_like(way), where=step > 0)
    return at, begin + u * since, u


def _stretches_at(curve: Curve, profile: Profile, times: np.ndarray) -> tuple[Any, Any]:
    """Grid points `[T]` twice, between which the motion is: the stops before and behind."""
    stops = np.flatnonzero(curve.stops)
    moves = np.diff(curve.grid[stops]) > 0
    first, last = stops[:-1][moves], stops[1:][moves]
    if len(first) < 2:
        return 0, len(curve.grid) - 1
    # A stretch begins with the last piece that is at rest where it begins, without any rounding.
    rests = np.asarray(profile.speed) == 0
    begins = [np.flatnonzero(rests & (profile.way == curve.grid[x]))[-1] for x in first]
    row = np.searchsorted(np.asarray(profile.times)[begins], times, side="right") - 1
    return first[row], last[row]


def followed(
    robot: Robot, trajectory: Trajectory | Setpoints, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Times `[T]`, positions, velocities and accelerations `[T D]` of a motion; or of those states
    of one that are given, whose accelerations are not known to be what they should.

    Raises:
        InputError: no motion, or none of this arm.
    """
    if isinstance(trajectory, Trajectory):
        times = sample_times(trajectory, dt)
        positions, velocities, accelerations = movement(trajectory, times)
    elif isinstance(trajectory, Setpoints):
        times, positions, velocities = (np.asarray(x, float) for x in trajectory[:3])
        accelerations = None
    else:
        raise InputError(
            f"a {type(trajectory).__name__} is no motion; give plan.trajectory, of a plan with "
            "trajectory=True, or Setpoints"
        )
    # All that is followed; what else was given is computed anew.
    points = Setpoints(times, positions, velocities, velocities, velocities)
    check_setpoints(robot, points, "the motion", "give what sample_trajectory returns")
    return times, positions, velocities, accelerations


def check_step(dt: float) -> None:
    """Refuses a time between states that is none, or so short that they fill the memory."""
    check_number(dt, "dt")
    if not 1e-5 <= dt < np.inf:
        raise InputError(f"dt is {dt}; give a step in seconds, such as 0.01")


def check_setpoints(robot: Robot, points: Setpoints, called: str, remedy: str) -> None:
    """Refuses states that are no motion of an arm.

    Args:
        robot: the arm.
        points: arrays of any shapes and values.
        called: what messages call them.
        remedy: where they could come from instead.
    """
    shape = (len(points.times), robot.num_dof) if points.times.ndim == 1 else (0, 0)
    if not shape[0] or any(x.shape != shape for x in points[1:]):
        shapes = {name: values.shape for name, values in points._asdict().items()}
        raise InputError(
            f"{called} has arrays of the shapes {shapes}; {robot.name} needs times [T] and "
            f"[T, {robot.num_dof}]"
        )
    if not all(np.isfinite(x).all() for x in points):
        raise InputError(f"{called} holds what is no finite number; {remedy}")
    if points.times[0] != 0 or not (np.diff(points.times) > 0).all():
        raise InputError(f"times in {called} do not begin at 0 and ascend; {remedy}")
    if beyond := beyond_limits(robot, points.positions, _ROUNDED):
        raise InputError(f"{called} {beyond}; name the arm that it was planned for")
