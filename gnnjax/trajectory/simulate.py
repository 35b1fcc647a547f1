"""Motions in MuJoCo's C engine: arms with contacts, told a thousand times a second what to do.

Torques are held for a step, as by motors that take digital commands, so that damping alone is
integrated implicitly. Many motions run side by side: per step, or per delay where that is longer,
the controller's torques are those of arrays, and the engine steps all arms in threads.
"""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from gnnjax.arm.mjcf import without_warnings
from gnnjax.arm.robot import Robot
from gnnjax.devices import num_cores
from gnnjax.errors import InputError, brief, check_number
from gnnjax.scene.allowed import last_link
from gnnjax.scene.mujoco_world import obstacles, place_obstacles, world_spec
from gnnjax.scene.scene import Scene
from gnnjax.trajectory.control import Law
from gnnjax.trajectory.states import Setpoints

DT = 1e-3  # s, of a step
_LONGEST_DELAY = 0.1  # s
_PAYLOAD_RADIUS = 0.05  # m
# MuJoCo's impedance of dry friction, 0.9 by default: of a joint of little inertia, that is far more
# viscous than dry, and such a joint runs ahead of what it is told to do.
_DRY = 0.9999
_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_TOLD = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
_FLAGS = mujoco.mjtDisableBit
# Of a contact sensor: whether there are contacts, and how far the two geoms of the deepest are
# apart.
_DEEPEST = [0b1001, 1, 1]


class ModelErrors(NamedTuple):
    """What a controller does not know of the arm that it moves."""

    mass: float = 0.0  # share by which all masses and inertias exceed the model's
    friction: float = 0.0  # dry friction of each joint beside the model's, N m or N
    delay: float = 0.0  # s from what is measured to the torque that answers it
    payload: float = 0.0  # kg, a ball of 50 mm at the origin of the last body


class Run(NamedTuple):
    """What became of a motion of T steps, the last it did."""

    positions: np.ndarray  # [T+1 D] rad or m
    velocities: np.ndarray  # [T+1 D] rad/s or m/s
    torques: np.ndarray  # [T D] N m or N, as the motors had them
    depths: np.ndarray  # [T] m, of the deepest contact at the beginning of each step
    diverged: bool  # it was stopped, since a joint was too far from where it should be


def check_errors(errors: ModelErrors) -> None:
    """Refuses errors that no arm can have.

    Raises:
        InputError: naming the value and what it may be.
    """
    if not isinstance(errors, ModelErrors):
        raise InputError(f"errors is {brief(errors)}; give ModelErrors(mass=0.1, ...)")
    allowed = {
        "mass": (-0.9, 10.0, "a share, such as 0.1"),
        "friction": (0.0, np.inf, "N m or N"),
        "delay": (0.0, _LONGEST_DELAY, "seconds, such as 0.004"),
        "payload": (0.0, np.inf, "kg"),
    }
    for name, value in errors._asdict().items():
        low, high, unit = allowed[name]
        check_number(value, f"{name} error")
        if not (low <= value <= high and np.isfinite(value)):
            raise InputError(f"{name} error is {value}; give {low:g} to {high:g} ({unit})")


def build_true_world(robot: Robot, scene: Scene, errors: ModelErrors) -> mujoco.MjModel:
    """The arm as it is, in one scene, to be moved by `qfrc_applied`; its last sensor tells of the
    deepest contact."""
    spec = world_spec(robot, len(scene.mask), scene.cloud)
    spec.option.timestep = DT
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags &= ~(int(_FLAGS.mjDSBL_SENSOR) | int(_FLAGS.mjDSBL_EULERDAMP))
    spec.option.disableflags |= int(_FLAGS.mjDSBL_ACTUATION) | int(_FLAGS.mjDSBL_AUTORESET)
    ball = None
    if errors.payload:
        inertia = 0.4 * errors.payload * _PAYLOAD_RADIUS**2
        ball = spec.bodies[last_link(robot) + 1].add_body(
            mass=errors.payload, inertia=[inertia] * 3, ipos=[0.0, 0.0, 0.0], explicitinertial=True
        )
    spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT, intprm=_DEEPEST)
    model = spec.compile()
    model.dof_frictionloss += errors.friction
    model.dof_solimp[:, :2] = np.maximum(model.dof_solimp[:, :2], _DRY)
    own = np.arange(model.nbody) != (-1 if ball is None else ball.id)  # without the payload
    model.body_mass[own] *= 1 + errors.mass
    model.body_inertia[own] *= 1 + errors.mass
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    return placed(model, scene)


def placed(model: mujoco.MjModel, scene: Scene) -> mujoco.MjModel:
    """A copy of a world with the obstacles of another scene, of as many and of the same cloud."""
    model = copy.copy(model)
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene)
    # Rollouts begin with mocap bodies where their model has them.
    found = obstacles(model, len(scene.mask))
    model.body_pos[found.bodies] = data.mocap_pos[found.mocaps]
    model.body_quat[found.bodies] = data.mocap_quat[found.mocaps]
    return model


def simulate(
    models: Sequence[mujoco.MjModel],
    laws: Sequence[Law],
    points: Sequence[Setpoints],
    limit: np.ndarray,
    delay: float,
    most_error: float,
) -> list[Run]:
    """Runs N motions, each in a world of its own, all of the same sizes.

    Args:
        models: of `build_true_world` or `placed`.
        laws: of the controller, at every step.
        points: where the arm should be, at every step.
        limit: `[D]` torques that motors have, N m or N.
        delay: s, rounded to steps.
        most_error: rad or m, of a joint, beyond which a motion has diverged.
    """
    steps = np.array([len(each.times) for each in points])
    wanted = _joined([each.positions for each in points])
    law = Law(
        before=np.stack([each.before for each in laws]),
        rest=_joined([each.rest for each in laws]),
        weight=_joined([each.weight for each in laws]),
        kp=laws[0].kp,
        kd=laws[0].kd,
        velocities=_joined([each.velocities for each in laws]),
    )
    num, total, joints = wanted.shape
    late = round(delay / DT)
    width = max(1, late)  # steps whose torques are known in advance
    state = np.stack([_initial(model, each) for model, each in zip(models, points, strict=True)])
    q, velocity = np.full((2, num, total + 1, joints), np.nan)
    q[:, 0], velocity[:, 0] = state[:, 1 : joints + 1], state[:, joints + 1 : 2 * joints + 1]
    torques, depths = np.zeros((num, total, joints)), np.zeros((num, total))
    done, alive, running = np.full(num, total + 1), np.arange(num), list(models)
    workers = [mujoco.MjData(models[0]) for _ in range(min(num_cores(), num))]
    with without_warnings(), Rollout(nthread=len(workers)) as engine:
        end = 0
        while len(alive):
            # No part goes beyond the end of a motion, which would depend on what is beside it.
            begin, end = end, min(end + width, int(steps[alive].min()))
            if begin < late:
                end = min(end, late)
            now, behind = slice(begin, end), slice(begin + 1, end + 1)
            seen = slice(begin - late, end - late)
            told = np.repeat(law.before[alive, None], end - begin, axis=1)
            if begin >= late:
                told = _told(law, alive, seen, wanted, q, velocity)
            torques[alive, now] = told = np.clip(told, -limit, limit)
            after, depths[alive, now] = _stepped(engine, workers, running, state, told)
            q[alive, behind] = after[..., 1 : joints + 1]
            velocity[alive, behind] = after[..., joints + 1 : 2 * joints + 1]
            off = np.abs(wanted[alive, min(end, total - 1)] - q[alive, end])
            good = (off <= most_error).all(axis=1)  # what is no number is not
            done[alive[~good]] = end
            goes_on = good & (end < steps[alive])
            alive, state = alive[goes_on], after[goes_on, -1]
            if not goes_on.all():
                running = [models[i] for i in alive.tolist()]
    return [
        Run(
            q[i, : last + 1],
            velocity[i, : last + 1],
            torques[i, :last],
            depths[i, :last],
            diverged=bool(done[i] <= steps[i]),
        )
        for i, last in enumerate(np.minimum(done, steps).tolist())
    ]


def _told(
    law: Law,
    alive: np.ndarray,
    seen: slice,
    wanted: np.ndarray,
    q: np.ndarray,
    velocity: np.ndarray,
) -> np.ndarray:
    """Torques `[A T D]` that a law answers what is seen of A motions with."""
    error = wanted[alive, seen] - q[alive, seen]
    slower = law.velocities[alive, seen] - velocity[alive, seen]
    push = (law.kp * error + law.kd * slower)[..., None]
    return law.rest[alive, seen] + (law.weight[alive, seen] @ push)[..., 0]


def _stepped(
    engine: Rollout,
    workers: list[mujoco.MjData],
    models: list[mujoco.MjModel],
    state: np.ndarray,
    torques: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """States `[A T S]` after steps with torques `[A T D]`, and depths of contacts before them."""
    shape = torques.shape[:2]
    after, sensed = np.empty((*shape, state.shape[1])), np.empty((*shape, models[0].nsensordata))
    engine.rollout(
        models,
        workers,
        np.ascontiguousarray(state),
        np.ascontiguousarray(torques),
        control_spec=_TOLD,
        skip_checks=True,  # arrays are of their shapes, and checking takes longer than a step
        nstep=shape[1],
        state=after,
        sensordata=sensed,
    )
    found, apart = np.moveaxis(sensed[..., models[0].sensor_adr[-1] :][..., :2], -1, 0)
    return after, np.where(found > 0, np.maximum(-apart, 0.0), 0.0)


def _initial(model: mujoco.MjModel, points: Setpoints) -> np.ndarray:
    """The state that a motion begins with."""
    data = mujoco.MjData(model)
    data.qpos, data.qvel = points.positions[0], points.velocities[0]
    state = np.empty(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, state, _STATE)
    return state


def _joined(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays `[T, ...]` one beside the other, the last row of shorter ones repeated."""
    total = max(len(row) for row in rows)
    return np.stack([row[np.minimum(np.arange(total), len(row) - 1)] for row in rows])
