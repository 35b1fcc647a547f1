"""From a certified path to a motion in time: rounded, and as fast as its limits allow."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import torques_at_rest
from gnnjax.clock import Clock
from gnnjax.collision.certify import beyond_limits
from gnnjax.devices import cache_compilations
from gnnjax.errors import InputError, check_number
from gnnjax.scene.scene import Scene, inflated
from gnnjax.trajectory.batches import over_curves
from gnnjax.trajectory.clearance import clearances_of
from gnnjax.trajectory.curve import Curve, edges_of, make_curve, places, size_of, stray
from gnnjax.trajectory.dynamics import check_dynamics
from gnnjax.trajectory.jerk import Profile, limit_jerk
from gnnjax.trajectory.limits import Limits
from gnnjax.trajectory.options import MotionOptions, check_motion_options, make_motion_options
from gnnjax.trajectory.smooth import Smoothed, smooth_paths
from gnnjax.trajectory.timing import Timing, fastest

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
# Where jerk is limited, a corner is narrow if it is passed more slowly than this many times the
# square of a joint's acceleration by its jerk: about what is gained while acceleration builds up.
_NARROW = 2.0
_MOST_STOPS = 16  # for that: each stretch between stops takes as long to find as the whole motion


class Trajectory(NamedTuple):
    """A motion along a rounded path, from rest to rest."""

    success: bool
    reason: str  # why there is no motion; empty on success
    duration: float  # s; inf without success
    certified: bool  # the whole curve is proven free of collisions
    cost_before: float  # length of the path, configuration units
    cost: float  # length of the curve
    # m, that the path provably keeps from all obstacles, up to 0.25; and the curve. Both are None
    # where they were not asked for.
    clearance_before: float | None
    clearance: float | None
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
    check_number(margin, "margin")
    if not 0 <= margin < np.inf:
        raise InputError(f"margin is {margin}; give a clearance in metres, or 0")
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
    moves = _moves(robot, limits, smoothed, clock)
    if limits.jerk is not None:
        moves = _without_narrow_corners(robot, limits, moves, clock)
    found = [_trajectory(robot, limits, move) for move in moves]
    if options.clearance:
        kept = clearances_of(robot, scene, [move.smooth for move in moves])
        found = [motion._replace(**each) for motion, each in zip(found, kept, strict=True)]
    each = (clock.now() - begin) / len(found)
    return [motion._replace(time_s=each) for motion in found]


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


class _Move(NamedTuple):
    """What a trajectory is made of."""

    smooth: Smoothed
    curve: Curve
    timing: Timing
    profile: Profile | None

    @property
    def moving(self) -> bool:
        """Whether there is a motion, jerk left aside."""
        return self.smooth.certified and int(self.timing.failed_at) < 0


def _moves(robot: Robot, limits: Limits, smoothed: Sequence[Smoothed], clock: Clock) -> list[_Move]:
    curves = [make_curve(x.path, x.blends, size_of(x.path)) for x in smoothed]
    timings = _timed(robot, limits, curves, clock)
    moves = [_Move(*each, None) for each in zip(smoothed, curves, timings, strict=True)]
    moving = [move.moving for move in moves]
    profiles = limit_jerk(robot, limits, curves, timings, moving, clock)
    return [move._replace(profile=each) for move, each in zip(moves, profiles, strict=True)]


def _without_narrow_corners(
    robot: Robot, limits: Limits, moves: list[_Move], clock: Clock
) -> list[_Move]:
    """Motions that stop at corners which are narrow for their jerk, where that takes less time.

    It is a stretch between stops that is slowed down as a whole, and a corner that is hardly
    rounded, as between points that are almost the same, would slow down all of it.
    """
    narrow = [_narrow(limits, move) for move in moves]
    rows = [i for i, some in enumerate(narrow) if some.any()]
    if not rows:
        return moves
    stopping = [
        moves[i].smooth._replace(blends=np.where(narrow[i], 0.0, moves[i].smooth.blends))
        for i in rows
    ]
    found = list(moves)
    for i, other in zip(rows, _moves(robot, limits, stopping, clock), strict=True):
        if other.profile is not None:
            own = moves[i].profile
            if own is None or other.profile.times[-1] < own.times[-1]:
                found[i] = other
    return found


def _narrow(limits: Limits, move: _Move) -> np.ndarray:
    """Which corners `[L - 2]` of a path are rounded, and narrow."""
    path, blends, _ = move.smooth
    if not (move.moving and blends.any()):
        return np.zeros(len(blends), bool)
    assert limits.jerk is not None
    slopes = np.maximum(np.abs(edges_of(path)[1]), 1e-12)
    push, jerk = ((x / slopes).min(axis=1) for x in (limits.acceleration, limits.jerk))
    gained = push**2 / jerk  # of the speed along each edge
    curve, number = move.curve, len(blends)
    middles = (curve.entries[:number] + curve.exits[:number]) // 2
    speeds = np.sqrt(move.timing.x[middles])
    slow = (speeds < _NARROW * np.maximum(gained[:-1], gained[1:])) & (blends > 0)
    slowest = np.argsort(np.where(slow, speeds, np.inf), kind="stable")
    slow[slowest[_MOST_STOPS:]] = False
    return slow


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


def _trajectory(robot: Robot, limits: Limits, move: _Move) -> Trajectory:
    smooth, curve, timing, profile = move
    reason, duration = "", float(timing.times[-1])
    if not smooth.certified:
        why = beyond_limits(robot, smooth.path) or "is not certified free of collisions"
        reason = f"the path {why}; plan another one"
    elif len(smooth.path) == 1 and limits.torque is not None and not _holds(robot, limits, curve):
        reason = _reason(robot, limits, curve, 0)
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


def _holds(robot: Robot, limits: Limits, curve: Curve) -> bool:
    """Whether motors hold the arm where a curve begins: the timing of none that moves is asked."""
    return bool((np.abs(torques_at_rest(robot, curve.start[None])) <= limits.torque).all())


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
