"""From a certified path to a motion in time: rounded, and as fast as its limits allow."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import inverse_dynamics_by_mujoco, torques_at_rest
from gnnjax.clock import Clock
from gnnjax.devices import cache_compilations
from gnnjax.errors import InputError
from gnnjax.scene.scene import Scene, inflated
from gnnjax.trajectory.batches import over_curves
from gnnjax.trajectory.clearance import clearances_of
from gnnjax.trajectory.curve import Curve, make_curve, places, size_of, stray
from gnnjax.trajectory.dynamics import check_dynamics
from gnnjax.trajectory.jerk import Profile, limit_jerk
from gnnjax.trajectory.limits import Limits
from gnnjax.trajectory.options import MotionOptions, check_motion_options, make_motion_options
from gnnjax.trajectory.smooth import Smoothed, smooth_paths
from gnnjax.trajectory.timing import Timing, fastest

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


class Setpoints(NamedTuple):
    """States at T times of a motion."""

    times: np.ndarray  # [T] s
    positions: np.ndarray  # [T D] rad or m
    velocities: np.ndarray  # [T D] rad/s or m/s
    accelerations: np.ndarray  # [T D] rad/s^2 or m/s^2
    torques: np.ndarray  # [T D] N m or N, of motors, without contacts


class Trajectory(NamedTuple):
    """A motion along a rounded path, from rest to rest."""

    success: bool
    reason: str  # why there is no motion; empty on success
    duration: float  # s; inf without success
    certified: bool  # the whole curve is proven free of collisions
    cost_before: float  # length of the path, configuration units
    cost: float  # length of the curve
    clearance_before: (
        float | None
    )  # m, that the path provably keeps from all obstacles, up to 0.25;
    clearance: float | None  # and the curve; both are None where they were not asked for
    stray: float  # how far the curve leaves the path at most, configuration units
    stops: int  # corners that could not be rounded, at which it rests
    time_s: float  # that it took to find, shared equally by a batch; no compilation
    curve: Curve
    timing: Timing  # the fastest motion without limits of jerk
    profile: Profile | None  # the motion itself, where jerk is limited


def time_path(
    robot: Robot,
    scene: Scene,
    path: ArrayLike,
    *,
    margin: float = 0.0,
    proven: bool = False,
    **options: Any,
) -> Trajectory:
    """The fastest motion along a path whose corners are rounded as far as is certified.

    Compiles for the first path of about its number of corners. Of a plan, that is what
    `planner.plan(..., trajectory=True)` does.

    Args:
        robot: the arm; what it holds is in its model, with its mass.
        scene: one scene.
        path: `[L, D]` configurations, one or more.
        margin: clearance from obstacles that the curve keeps, m.
        proven: the path is certified already, with that margin, as those of plans are. Then only
            what is rounded is certified, which takes a fraction of the time.
        options: see `MotionOptions`: velocity, acceleration, torque, jerk, blend, clearance.

    Raises:
        InputError: no such path or option; limits that are missing or not positive; an arm whose
            dynamics are not known.
    """
    return time_paths(robot, scene, [path], margin=margin, proven=proven, **options)[0]


def time_paths(
    robot: Robot,
    scene: Scene,
    paths: Sequence[ArrayLike],
    *,
    margin: float = 0.0,
    proven: bool = False,
    **options: Any,
) -> list[Trajectory]:
    """`time_path` of P paths, in one scene or in P scenes `[P, M, ...]`, one each."""
    return find_motions(robot, scene, paths, make_motion_options(**options), margin, proven=proven)


def find_motions(
    robot: Robot,
    scene: Scene,
    paths: Sequence[ArrayLike],
    options: MotionOptions,
    margin: float,
    *,
    proven: bool,
) -> list[Trajectory]:
    """`time_paths` with its options in one."""
    limits = check_motion_options(robot, options)
    if not paths:
        return []
    if np.ndim(scene.mask) == 2 and len(scene.mask) != len(paths):
        raise InputError(f"{len(paths)} paths in {len(scene.mask)} scenes; give one scene a path")
    clock = Clock()
    begin = clock.now()
    if limits.torque is not None:
        clock.remembered(check_dynamics, robot)
    checked = [_checked(robot, path) for path in paths]
    thick = inflated(scene, margin)
    smoothed = smooth_paths(robot, thick, checked, options.blend, proven=proven)
    curves = [make_curve(x.path, x.blends, size_of(x.path)) for x in smoothed]
    timings = _timed(robot, limits, curves, clock)
    moving = [x.certified and int(t.failed_at) < 0 for x, t in zip(smoothed, timings, strict=True)]
    profiles = limit_jerk(robot, limits, curves, timings, moving, clock)
    found = [
        _trajectory(robot, limits, *each)
        for each in zip(smoothed, curves, timings, profiles, strict=True)
    ]
    if options.clearance:
        kept = clearances_of(robot, scene, smoothed)
        found = [motion._replace(**each) for motion, each in zip(found, kept, strict=True)]
    each = (clock.now() - begin) / len(found)
    return [motion._replace(time_s=each) for motion in found]


def sample_trajectory(robot: Robot, trajectory: Trajectory, dt: float) -> Setpoints:
    """States of a motion every `dt` seconds, and at its end.

    Torques are those of MuJoCo's inverse dynamics, without contacts, and of dry friction.

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
    if not trajectory.success:
        raise InputError(f"there is no motion to sample: {trajectory.reason}")
    count = int(np.ceil(trajectory.duration / dt - 1e-9))
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
    speed = np.maximum(speed, 0.0)[:, None]
    place = places(curve, at)
    positions = np.asarray(place.q)
    velocities = np.asarray(place.slope) * speed
    accelerations = np.asarray(place.slope * push[:, None] + place.bend * speed**2)
    return positions, velocities, accelerations


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


def check_step(dt: float) -> None:
    """Refuses a time between states that is none, or so short that they fill the memory."""
    if not 1e-5 <= dt < np.inf:
        raise InputError(f"dt is {dt}; give a step in seconds, such as 0.01")


def _checked(robot: Robot, path: ArrayLike) -> np.ndarray:
    try:
        array = np.asarray(path, float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim != 2 or array.shape[-1] != robot.num_dof or not len(array):
        raise InputError(
            f"path has shape {array.shape}; {robot.name} needs [L, {robot.num_dof}], one "
            "configuration or more"
        )
    if not np.isfinite(array).all():
        raise InputError("path holds what is no finite number; give joint values")
    return array


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


def _trajectory(
    robot: Robot,
    limits: Limits,
    smooth: Smoothed,
    curve: Curve,
    timing: Timing,
    profile: Profile | None,
) -> Trajectory:
    reason, duration = "", float(timing.times[-1])
    if not smooth.certified:
        reason = "the path is not certified free of collisions; plan another one"
    elif timing.failed_at >= 0:
        reason = _reason(robot, limits, curve, int(timing.failed_at))
    elif limits.jerk is not None:
        if profile is None:
            weakest = _reason(robot, limits, curve, *range(len(curve.grid)))
            reason = f"slow enough for the limits of jerk, {weakest}"
        else:
            duration = float(profile.times[-1])
    path = smooth.path
    before = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    fine = places(curve, np.arange(0, len(curve.grid) - 0.875, 0.125)).q
    return Trajectory(
        success=not reason,
        reason=reason,
        duration=np.inf if reason else duration,
        certified=smooth.certified,
        cost_before=before,
        cost=float(np.linalg.norm(np.diff(fine, axis=0), axis=1).sum()),
        clearance_before=None,
        clearance=None,
        stray=float(stray(path, smooth.blends).max(initial=0.0)),
        stops=int((smooth.blends == 0).sum()),
        time_s=0.0,
        curve=curve,
        timing=timing,
        profile=profile,
    )


def _reason(robot: Robot, limits: Limits, curve: Curve, *points: int) -> str:
    """Why nothing leads on from grid points of a curve, or why the arm cannot even rest."""
    assert limits.torque is not None  # without torques, rest is always allowed
    last = len(curve.grid) - 1
    at = np.append(np.flatnonzero(curve.stops), points)  # the start comes first
    place = places(curve, at.astype(float))
    needed = np.abs(torques_at_rest(robot, np.asarray(place.q)))
    shares = (needed / limits.torque).max(axis=1)
    row = int((shares > 1).argmax()) if (shares > 1).any() else len(at) - 1
    joint = int((needed[row] / limits.torque).argmax())
    name, need, limit = robot.joint_names[joint], needed[row, joint], limits.torque[joint]
    ends = {0: "at the start", last: "at the goal"}
    along = curve.grid[at[row]] / max(curve.grid[-1], 1e-12)
    where = ends.get(int(at[row]), f"{along:.0%} along the path (grid point {at[row]})")
    unit = "N m" if robot.mj_model.jnt_type[joint] == _HINGE else "N"
    if need > limit:
        return (
            f"joint {name} needs {need:.4g} {unit} to hold the arm {where} and has {limit:.4g}; "
            "carry less, or plan elsewhere"
        )
    return (
        f"no speed keeps the limits {where}: joint {name} needs {need:.4g} of its {limit:.4g} "
        f"{unit} to hold the arm alone"
    )
