"""Controllers of arms: what their motors are told, from what they should do and what is measured.

A controller knows the arm's model, which need not be the arm that it moves, and a motion
beforehand. What it does for each instant is a line of torques in position and velocity, so that
many motions are controlled at once.
"""

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import torques_at_rest
from gnnjax.errors import InputError, brief
from gnnjax.trajectory.states import Setpoints

# rad/s, of errors under `computed_torque`, which they leave without overshoot: a hundredth of the
# rate at which motors are told anew, and slow enough for delays of ten milliseconds.
_BANDWIDTH = 40.0
_SERVO = 20.0  # rad/s, of position servos where the model of an arm has none
_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


class Law(NamedTuple):
    """Torques [N m or N] at T instants, before motors limit them:
    `rest + weight @ (kp * (q wanted - q) + kd * (velocity wanted - velocity))`."""

    before: np.ndarray  # [D] until the first of them arrives
    rest: np.ndarray  # [T D]
    weight: np.ndarray  # [T D D]
    kp: np.ndarray  # [D]
    kd: np.ndarray  # [D]
    velocities: np.ndarray  # [T D] wanted, rad/s or m/s


def control(robot: Robot, controller: str, points: Setpoints) -> Law:
    """What a controller does for a motion.

    Args:
        robot: the arm as the controller knows it.
        controller: a key of `CONTROLLERS`.
        points: the motion at T instants.

    Raises:
        InputError: no such controller.
    """
    if not isinstance(controller, str) or controller not in CONTROLLERS:
        raise InputError(f"no controller {brief(controller)}; there are {list(CONTROLLERS)}")
    return CONTROLLERS[controller](robot, points)


def computed_torque(robot: Robot, points: Setpoints) -> Law:
    """The torques that the model needs for the motion, and a spring and damper for errors, each
    weighted by the inertia where the arm should be."""
    rates = np.full(robot.num_dof, _BANDWIDTH)
    inertia = inertias(robot, points.positions)
    before = torques_at_rest(robot, points.positions[:1])[0]
    return Law(before, points.torques, inertia, rates**2, 2 * rates, points.velocities)


def position_servos(robot: Robot, points: Setpoints) -> Law:
    """A spring to where each joint should be, a damper to rest, and the model's weight where the
    arm should be.

    Gains are those of the model's position actuators. Where a joint has none, they give the
    diagonal of its inertia at home 20 rad/s and no overshoot. As the damper does not know the
    velocity that is wanted, the arm comes `kd / kp` late: that is what such servos do.
    """
    still = np.zeros_like(points.positions)
    weight = torques_at_rest(robot, points.positions)
    kp, kd = _servo_gains(robot)
    same = np.broadcast_to(np.eye(robot.num_dof), (len(still), *2 * (robot.num_dof,)))
    return Law(weight[0], weight, same, kp, kd, still)


CONTROLLERS: dict[str, Callable[[Robot, Setpoints], Law]] = {
    "computed_torque": computed_torque,
    "position": position_servos,
}


def inertias(robot: Robot, q: np.ndarray) -> np.ndarray:
    """The model's inertia `[B D D]` at q `[B D]`, with that of rotors, kg m^2 (kg; kg m)."""
    model = robot.mj_model
    data, found = mujoco.MjData(model), np.empty((*q.shape, robot.num_dof))
    for row in range(len(found)):
        data.qpos = q[row]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_crb(model, data)
        mujoco.mj_fullM(model, data, found[row])
    return found


def _servo_gains(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Of each joint, `[D]` twice."""
    model = robot.mj_model
    (own,) = inertias(robot, np.asarray(robot.home, float)[None])
    kp, kd = _SERVO**2 * np.diag(own), 2 * _SERVO * np.diag(own)
    for a in range(model.nu):
        spring, damper = -model.actuator_biasprm[a, 1:3] * model.actuator_gear[a, 0] ** 2
        is_servo = int(model.actuator_trntype[a]) in _JOINTS and spring > 0 and damper > 0
        if is_servo and model.actuator_gainprm[a, 0] == -model.actuator_biasprm[a, 1]:
            joint = int(model.actuator_trnid[a, 0])
            kp[joint], kd[joint] = spring, damper
    return kp, kd
