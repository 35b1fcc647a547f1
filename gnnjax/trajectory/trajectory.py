"""From a certified path to a motion in time: rounded, and as fast as its limits allow."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import torques_at_rest
from gnnjax.clock import Clock
from gnnjax.collision.certify import beyond_limits
from gnnjax.errors import InputError, check_number
from gnnjax.scene.scene import Scene, check_is_scene, inflated
from gnnjax.trajectory.clearance import clearances_of
from gnnjax.trajectory.curve import Curve, places, stray
from gnnjax.trajectory.dynamics import check_dynamics
from gnnjax.trajectory.jerk import Profile
from gnnjax.trajectory.limits import Limits
from gnnjax.trajectory.moves import Move, find_moves
from gnnjax.trajectory.options import MotionOptions, check_motion_options, make_motion_options
from gnnjax.trajectory.smooth import smooth_paths
from gnnjax.trajectory.timing import Timing

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


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
    paths: Sequence[ArrayLike] | np.ndarray,
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
    paths: Sequence[ArrayLike] | np.ndarray,
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
    if not len(paths):  # it may be an array
        return []
    check_is_scene(scene)
    if np.ndim(scene.mask) == 2 and len(scene.mask) != len(paths):
        raise InputError(f"{len(paths)} paths in {len(scene.mask)} scenes; give one scene a path")
    clock = Clock()
    begin = clock.now()
    if limits.torque is not None:
        clock.remembered(check_dynamics, robot)
    checked = [_checked(robot, path) for path in paths]
    thick = inflated(scene, margin)
    smoothed = smooth_paths(robot, thick, checked, options.blend, proven=proven)
    moves = find_moves(robot, limits, smoothed, clock)
    found = [_trajectory(robot, limits, move) for move in moves]
    if options.clearance:
        kept = clearances_of(robot, scene, [move.smooth for move in moves])
        found = [motion._replace(**each) for motion, each in zip(found, kept, strict=True)]
    each = (clock.now() - begin) / len(found)
    return [motion._replace(time_s=each) for motion in found]


def _checked(robot: Robot, path: ArrayLike) -> np.ndarray:
    try:
        array = np.asarray(path, float)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.ndim != 2 or array.shape[-1] != robot.num_dof or not len(array):
        raise InputError(
            f"path has shape {array.shape}; {robot.name} needs [L, {robot.num_dof}], one "
            "configuration or more"
        )
    if not np.isfinite(array).all():
        raise InputError("path holds what is no finite number; give joint values")
    return array


def _trajectory(robot: Robot, limits: Limits, move: Move) -> Trajectory:
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
