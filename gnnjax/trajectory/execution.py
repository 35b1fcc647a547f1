"""Motions carried out in simulation: how well an arm follows them, and what it touches."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm.shipped import in_kind
from gnnjax.collision.bounds import spheres_of
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.margins import largest_margin
from gnnjax.errors import InputError, check_number
from gnnjax.scene.allowed import last_link
from gnnjax.scene.mujoco_world import obstacles
from gnnjax.scene.scene import Scene, check_is_scene, inflated, obstacle_name
from gnnjax.trajectory.control import control
from gnnjax.trajectory.dynamics import check_dynamics
from gnnjax.trajectory.limits import ANY_TORQUE, Amounts, limits_of
from gnnjax.trajectory.simulate import (
    DT,
    ModelErrors,
    Run,
    build_true_world,
    check_errors,
    placed,
    simulate,
)
from gnnjax.trajectory.states import Setpoints
from gnnjax.trajectory.steps import HOLD, at_steps
from gnnjax.trajectory.trajectory import Trajectory

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_AT_REST = 0.02  # rad or m, and rad/s or m/s, of each joint
_SIDE_BY_SIDE = 32  # motions whose arrays are in memory at a time
_PIECE = 20  # steps of a motion that are certified as one line, with slack


class Trace(NamedTuple):
    """A motion as it was, every millisecond, and as it was wanted."""

    times: np.ndarray  # [T] s
    positions: np.ndarray  # [T D] rad or m
    velocities: np.ndarray  # [T D] rad/s or m/s
    torques: np.ndarray  # [T D] N m or N, as the motors had them
    wanted: Setpoints  # [T ...]
    torque_limit: np.ndarray  # [D] of the motors


class Execution(NamedTuple):
    """What became of a motion."""

    success: bool  # nothing was touched, and the arm rests at the goal
    reason: str  # why not; empty on success
    duration: float  # s, that the motion should take
    max_error: np.ndarray  # [D] from where each joint should be at the time, rad or m
    rms_error: np.ndarray  # [D]
    tip_error: float  # of the last body's origin, m, largest
    goal_error: float  # of any joint in the end, rad or m
    stray: float  # m; no point of the arm is farther from where it is on the curve, at any time
    proven: bool  # the curve is proven to keep more than that from all obstacles
    depth: float  # m, of the deepest contact; 0: none
    touched_at: float  # s, of the first contact; inf: none
    touched: tuple[str, ...]  # the two that touched first
    torque_use: float  # largest share of any motor's limit
    settled: bool
    trace: Trace


def execute_trajectory(
    robot: Robot,
    scene: Scene,
    trajectory: Trajectory | Setpoints,
    *,
    controller: str = "computed_torque",
    torque: Amounts | None = None,
    errors: ModelErrors | None = None,
    most_error: float = 0.5,
) -> Execution:
    """Carries a motion out in MuJoCo, with contacts and a controller that knows the model alone.

    Args:
        robot: the arm, as the controller knows it; what it holds is in its model, with its mass.
        scene: one scene, without allowed contacts.
        trajectory: of `time_path`; or states of a motion, between which it is interpolated.
        controller: "computed_torque", or "position" (servos), see `gnnjax.trajectory.control`.
        torque: limits of motors, N m or N, one for all joints or one each; the model's by default.
        errors: how the arm differs from its model; by default not at all.
        most_error: rad or m, of a joint, beyond which a motion has diverged and is stopped.

    Raises:
        InputError: no motion, an unknown controller, errors that no arm has, no torque limits, or
            an arm or scene that cannot be simulated.
    """
    (found,) = execute_trajectories(
        robot,
        scene,
        [trajectory],
        controller=controller,
        torque=torque,
        errors=errors,
        most_error=most_error,
    )
    return found


def execute_trajectories(
    robot: Robot,
    scene: Scene,
    trajectories: Sequence[Trajectory | Setpoints],
    *,
    controller: str = "computed_torque",
    torque: Amounts | None = None,
    errors: ModelErrors | None = None,
    most_error: float = 0.5,
) -> list[Execution]:
    """`execute_trajectory` of P motions, in one scene or in P scenes `[P, M, ...]`, one each."""
    errors = errors or ModelErrors()
    check_errors(errors)
    check_number(most_error, "most_error")
    if not 0 < most_error < np.inf:
        raise InputError(f"most_error is {most_error}; give a positive number (rad or m)")
    check_is_scene(scene)
    several = np.ndim(scene.mask) == 2
    if several and len(scene.mask) != len(trajectories):
        raise InputError(
            f"{len(trajectories)} motions in {len(scene.mask)} scenes; give one scene a motion"
        )
    limit = _torque_limit(robot, torque)
    check_dynamics(robot)
    scenes = [jax.tree.map(lambda x, i=i: np.asarray(x)[i], scene) for i in _numbers(scene)]
    points = [at_steps(robot, each) for each in trajectories]
    found: list[Execution | None] = [None] * len(points)
    # Those of about the same length side by side; clouds are geoms, which make worlds that differ.
    order = np.argsort([len(each.times) for each in points], kind="stable")
    size = 1 if scene.cloud is not None and several else _SIDE_BY_SIDE
    world = None
    for first in range(0, len(order), size):
        rows = order[first : first + size].tolist()
        own = [scenes[i if several else 0] for i in rows]
        if world is None or size == 1:
            world = build_true_world(robot, own[0], errors)
        models = [placed(world, each) for each in own] if several else [world] * len(rows)
        laws = [control(robot, controller, points[i]) for i in rows]
        runs = simulate(models, laws, [points[i] for i in rows], limit, errors.delay, most_error)
        for i, model, each, run in zip(rows, models, own, runs, strict=True):
            found[i] = _judged(robot, each, model, points[i], run, limit)
    return [each for each in found if each is not None]


def _numbers(scene: Scene) -> list:
    """Indices that take the scenes out of one or several."""
    return list(range(len(scene.mask))) if np.ndim(scene.mask) == 2 else [...]


def _torque_limit(robot: Robot, torque: Amounts | None) -> np.ndarray:
    limit = limits_of(robot, velocity=1.0, acceleration=1.0, torque=torque).torque
    if limit is None or (limit >= ANY_TORQUE).any():
        joint = "" if limit is None else f" for joint {robot.joint_names[int(limit.argmax())]}"
        where = in_kind(
            robot.path,
            mjcf='forcerange="..." into its actuators',
            urdf='<limit effort="..."/> into its URDF',
        )
        raise InputError(
            f"the model of {robot.name} has no torque limits{joint}, without which its motors "
            f"cannot be simulated; give torque=... (N m), or put {where}"
        )
    return limit


def _judged(
    robot: Robot,
    scene: Scene,
    model: mujoco.MjModel,
    wanted: Setpoints,
    run: Run,
    limit: np.ndarray,
) -> Execution:
    """What a run says of a motion."""
    whole, steps = wanted, len(run.torques)
    if run.diverged:  # within a delay, up to what is no number
        steps = min(steps, int(np.isfinite(run.positions).all(axis=1).argmin()) or steps)
    q, velocity, torques = run.positions[:steps], run.velocities[:steps], run.torques[:steps]
    wanted = Setpoints(*(x[:steps] for x in wanted))
    moving = max(1, steps if run.diverged else steps - round(HOLD / DT))
    error = np.abs(q - wanted.positions)
    tip = np.linalg.norm(_tips(robot, q) - _tips(robot, wanted.positions), axis=1)
    touching = np.flatnonzero(run.depths[:steps] > 0)
    goal, speed = error[-1], np.abs(velocity[-1])
    settled = bool(not run.diverged and max(goal.max(), speed.max()) <= _AT_REST)
    touched = _pair(robot, scene, model, q[touching[0]]) if len(touching) else ()
    depth = float(run.depths.max())
    joint = int(error[-1].argmax())
    stray = _stray(robot, wanted.positions, q)
    reason = ""
    if touched:
        when = f"{touching[0] * DT:.3f} s, and by up to {1e3 * depth:.1f} mm"
        reason = f"{touched[0]} touches {touched[1]} after {when}"
    elif run.diverged:
        reason = (
            f"joint {robot.joint_names[joint]} was {error[-1, joint]:.3g} {_unit(robot, joint)} "
            f"from where it should be after {steps * DT:.3f} s"
        )
    elif not settled:
        joint = int(np.maximum(goal, speed).argmax())
        unit = _unit(robot, joint)
        reason = (
            f"the arm does not rest at the goal: at the end joint {robot.joint_names[joint]} is "
            f"{goal[joint]:.3g} {unit} away from it and moves at {speed[joint]:.3g} {unit}/s "
            f"({_AT_REST:g} allowed)"
        )
    return Execution(
        success=not reason,
        reason=reason,
        duration=max(1, len(whole.times) - round(HOLD / DT)) * DT,
        max_error=error.max(axis=0),
        rms_error=np.sqrt((error[:moving] ** 2).mean(axis=0)),
        tip_error=float(tip.max()),
        goal_error=float(goal.max()),
        stray=stray,
        proven=stays_clear(robot, scene, whole.positions, stray),
        depth=depth,
        touched_at=float(touching[0] * DT) if len(touching) else np.inf,
        touched=touched,
        torque_use=float((np.abs(torques) / limit).max()),
        settled=settled,
        trace=Trace(wanted.times, q, velocity, torques, wanted, limit),
    )


def _unit(robot: Robot, joint: int) -> str:
    return "rad" if robot.mj_model.jnt_type[joint] == _HINGE else "m"


def _tips(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Origins [m] of the last body at q `[T D]`, `[T 3]`."""
    data, found = mujoco.MjData(robot.mj_model), np.empty((len(q), 3))
    for row in range(len(q)):
        data.qpos = q[row]
        mujoco.mj_kinematics(robot.mj_model, data)
        found[row] = data.xpos[last_link(robot) + 1]
    return found


def _stray(robot: Robot, curve: np.ndarray, q: np.ndarray) -> float:
    """A bound [m] on how far points of the arm at q `[T D]` are from where they are at the nearest
    of the states of a curve."""
    reach = spheres_of(robot).part_reach.max(axis=0)  # m/rad or m/m, of the point that moves most
    from scipy.spatial import cKDTree  # a fifth of a second, for this alone

    away, _ = cKDTree(curve * reach).query(q * reach, p=1)
    return float(away.max())


def stays_clear(robot: Robot, scene: Scene, q: np.ndarray, margin: float) -> bool:
    """Whether the arm is proven to keep more than a distance [m] from all obstacles along the curve
    whose states at every step are q `[T D]`."""
    pieces = np.arange(0, len(q) - 1, _PIECE)
    ends = np.minimum(pieces + _PIECE, len(q) - 1)
    inside = np.minimum(pieces + np.arange(_PIECE + 1)[:, None], ends)
    share = ((inside - pieces) / (ends - pieces))[..., None]
    slack = np.abs(q[inside] - (1 - share) * q[pieces] - share * q[ends]).max(axis=0)
    # Between steps, a curve of a thousand rad/s^2 leaves its chord by less than what is added.
    larger, slack = inflated(scene, margin), slack + 1e-4
    return bool(certify_edges(robot, larger, q[pieces], q[ends], slack=slack).all())


def motion_clearance(robot: Robot, scene: Scene, q: np.ndarray) -> float:
    """The largest such distance [m], to a millimetre, up to 0.25 m; 0 where not even the curve
    itself is proven free."""
    return largest_margin(lambda margin: stays_clear(robot, scene, q, margin)) or 0.0


def _pair(robot: Robot, scene: Scene, model: mujoco.MjModel, q: np.ndarray) -> tuple[str, ...]:
    """The two whose contact is the deepest."""
    data = mujoco.MjData(model)
    data.qpos = q
    mujoco.mj_fwdPosition(model, data)
    number = int(np.argmin(data.contact.dist[: data.ncon]))
    return tuple(_called(robot, scene, model, int(g)) for g in data.contact.geom[number])


def _called(robot: Robot, scene: Scene, model: mujoco.MjModel, geom: int) -> str:
    """How messages call a geom of a world, whose last ones are the obstacles."""
    placed_at = obstacles(model, len(scene.mask)).geoms.tolist()
    if geom in placed_at:
        return obstacle_name(scene, placed_at.index(geom))
    parts = robot.part_geoms.tolist()
    return robot.parts[parts.index(geom)].name if geom in parts else "the cloud"
