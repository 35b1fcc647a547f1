"""Torques of an arm's motors, and the choice to plan where they can hold the arm at rest.

What holds an arm is a property of the arm alone, like whether it touches itself: where its weight,
with what it holds, takes more than the motors may give, a motion can at best swing through.
"""

import copy
import dataclasses
import functools
from collections.abc import Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.arm.bodies import Joint
from gnnjax.arm.kinematics import (
    WORLD,
    Frame,
    Scalar,
    Vector,
    add,
    cross,
    dot,
    joint_terms,
    move_joint,
    multiply,
    product,
    subtract,
    transform_point,
)
from gnnjax.arm.reading import motor_limits
from gnnjax.arm.robot import Robot
from gnnjax.arm.shipped import in_kind
from gnnjax.errors import InputError, as_floats, brief, check_number

Amounts: TypeAlias = float | int | Sequence | np.ndarray  # one for all joints, or one each

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
# Share of limits that kernels leave for what single precision rounds off, some 1e-6.
_ROUNDING = 1e-4
_SAME = 1e-6  # relative; in double precision own torques and MuJoCo's agree to 1e-12
_STATES = 4  # at which they are compared


def at_rest_within(robot: Robot, share: float, torque: Amounts | None = None) -> Robot:
    """An arm that is planned for only where a share of its motors' torques holds it at rest: a new
    `Robot` of the same name; the old one is as it was.

    Configurations that take more, by gravity and springs, with the mass of what the arm holds,
    before or after this (`attach`), are not valid: no planner goes there, and a start or goal there
    is refused. Edges are tested at samples, as for contacts. Certificates say nothing of torques,
    and a motion's are those that its timing keeps, all along its curve: give that somewhat more
    than this share, since it also has to move.

    The same arguments give the same object, of the last 32: kernels are compiled once for each.

    Args:
        robot: the arm.
        share: of the limits, above 0, up to 1.
        torque: limits in place of the model's, N m or N, one for all joints or one each.

    Raises:
        InputError: a share or limits that are none; a joint without a limit; an arm that is held by
            other forces than those of motors and springs.
    """
    check_number(share, "the share of torques at rest")
    if not 0 < share <= 1:
        raise InputError(
            f"the share of torques at rest is {brief(share)}; give one above 0, up to 1"
        )
    limit = own_torques(robot) if torque is None else positive_amounts(robot, "torque", torque)
    if not np.isfinite(limit).all():
        without = robot.joint_names[int(np.isfinite(limit).argmin())]
        where = in_kind(
            robot.path,
            mjcf='actuatorfrcrange="-T T" into its MJCF',
            urdf='<limit effort="T"/> into its URDF',
        )
        raise InputError(
            f"joint {without} of {robot.name} has no torque limit to take a share of; give "
            f"torque=... (N m, one for all joints or one each), or put {where}"
        )
    return _resting(robot, tuple((share * np.asarray(limit, float)).tolist()))


@functools.lru_cache(maxsize=32)
def _resting(robot: Robot, limit: tuple[float, ...]) -> Robot:
    q = np.random.default_rng(0).uniform(
        robot.joint_lower, robot.joint_upper, (_STATES, robot.num_dof)
    )
    wanted = torques_at_rest(robot, q)
    with jax.enable_x64(True):  # step by step: compiling would take longer
        found = np.stack([np.broadcast_to(x, _STATES) for x in _holding(robot, jnp.asarray(q))], 1)
    off = np.abs(found - wanted).max(axis=0)
    if not off.max() <= _SAME * (1e-6 + np.abs(wanted).max()):
        raise InputError(
            f"joint {robot.joint_names[int(off.argmax())]} of {robot.name} is held by other forces "
            "than gravity and linear springs (tendons, equalities), or lacks one of these (by "
            "<flag>); take the others, and the flags, out of the model"
        )
    return dataclasses.replace(robot, rest_limit=np.array(limit))


def own_torques(robot: Robot) -> np.ndarray:
    """Limits `[D]` of torques by the model, N m or N, infinite of joints without.

    Raises:
        InputError: a joint that motors push one way only.
    """
    limits = motor_limits(robot.mj_model)
    if not limits.all():
        raise InputError(
            f"the motors of joint {robot.joint_names[int(limits.argmin())]} of {robot.name} push "
            "one way only, by a forcerange, ctrlrange or actuatorfrcrange without both signs; give "
            "torque=... (N m, one for all joints or one each), or mend the range"
        )
    return limits


def positive_amounts(robot: Robot, name: str, values: Amounts) -> np.ndarray:
    """Numbers `[D]`, of one or one a joint, or what is wrong with them.

    Raises:
        InputError: others than positive numbers, or too many.
    """
    try:
        array = as_floats(values)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    fits = array.shape in ((), (1,), (robot.num_dof,))
    if not fits or not ((array > 0) & np.isfinite(array)).all():
        raise InputError(
            f"{name} limits of {robot.name} are {brief(values)}; give one positive number, or "
            f"{robot.num_dof}, one a joint"
        )
    return np.broadcast_to(array, robot.num_dof)


def can_rest(robot: Robot, q: Float[Array, "*batch D"]) -> Bool[Array, "*batch"]:
    """Whether the arm may rest at configurations, for kernels, of an arm with a `rest_limit`; a
    little less often than `rests`, never where that is false, and not at NaN."""
    return rest_use(robot, q) <= 1 - _ROUNDING  # not so for NaN


def rest_use(robot: Robot, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
    """The largest share of a joint's `rest_limit` that holds the arm at configurations."""
    assert robot.rest_limit is not None
    largest = jnp.zeros(q.shape[:-1], q.dtype)
    for torque, limit in zip(_holding(robot, q), robot.rest_limit.tolist(), strict=True):
        largest = jnp.maximum(largest, jnp.abs(torque) / limit)
    return largest


def rests(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Whether the arm may rest at configurations `[B D]`, `[B]`, by MuJoCo; everywhere, for one
    that has no `rest_limit`."""
    if robot.rest_limit is None:
        return np.ones(len(q), bool)
    return np.all(np.abs(torques_at_rest(robot, q)) <= robot.rest_limit, axis=1)


def rest_fault(robot: Robot, q: np.ndarray) -> tuple[str, str]:
    """Of an arm that may not rest at q `[D]`: the joint that is most beyond its limit, and what it
    needs, in words."""
    assert robot.rest_limit is not None
    (needed,) = np.abs(torques_at_rest(robot, q[None]))
    joint = int((needed / robot.rest_limit).argmax())
    unit = "N m" if robot.mj_model.jnt_type[joint] == _HINGE else "N"
    name, limit = robot.joint_names[joint], robot.rest_limit[joint]
    return name, f"needs {needed[joint]:.4g} {unit} to hold the arm and may take {limit:.4g}"


def torques_at_rest(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Torques `[B D]` [N m or N] with which motors hold the arm at q `[B D]`, by MuJoCo's C
    engine."""
    still = np.zeros_like(q, float)
    return inverse_dynamics_by_mujoco(robot, q, still, still)


def inverse_dynamics_by_mujoco(
    robot: Robot, q: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> np.ndarray:
    """Torques [N m or N] that motors exert at states `[B D]`, by MuJoCo's C engine, without
    contacts and joint limits, with dry friction."""
    model = _unconstrained(robot)
    data, found = mujoco.MjData(model), np.empty(np.shape(q))
    for row in range(len(found)):
        data.qpos, data.qvel, data.qacc = q[row], velocity[row], acceleration[row]
        mujoco.mj_inverse(model, data)
        found[row] = data.qfrc_inverse
    return found + model.dof_frictionloss * np.sign(velocity)


@functools.cache
def _unconstrained(robot: Robot) -> mujoco.MjModel:
    model = copy.copy(robot.mj_model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return model


def _holding(robot: Robot, q: Float[Array, "*batch D"]) -> list[Scalar]:
    """Torques of the D motors that hold the arm, as straight-line code (see `kinematics.py`).

    All that hangs on a joint pulls as if it were in one point.
    """
    # Behind a barrier, or the compiler computes cosines anew for each torque.
    joints = jax.lax.optimization_barrier(joint_terms(robot, q))
    gravity = robot.mj_model.opt.gravity.tolist()
    frames: list[Frame] = []
    axes: list[tuple[int, Joint, Vector, Vector]] = []  # body, joint, direction, anchor
    for number, body in enumerate(robot.bodies):
        position, rotation = frames[body.parent] if body.parent >= 0 else WORLD
        position = transform_point(position, rotation, body.position.tolist())
        rotation = product(rotation, body.rotation.tolist())
        for joint in body.joints:  # whose own turn leaves its axis alone
            direction = [dot(row, joint.axis.tolist()) for row in rotation]
            anchor = transform_point(position, rotation, joint.anchor.tolist())
            axes.append((number, joint, direction, anchor))
            position, rotation = move_joint(joint, position, rotation, joints)
        frames.append((position, rotation))

    # Mass, and mass times middle, of bodies, and then of all that hangs on them.
    masses, moments = _weights(robot)
    sums = [
        transform_point([multiply(x, mass) for x in position], rotation, moment)
        for (position, rotation), mass, moment in zip(frames, masses, moments, strict=True)
    ]
    for number, body in reversed([*enumerate(robot.bodies)]):
        if body.parent >= 0:
            masses[body.parent] += masses[number]
            both = zip(sums[body.parent], sums[number], strict=True)
            sums[body.parent] = [add(a, b) for a, b in both]

    torques: list[Scalar] = [0.0] * robot.num_dof
    stiffness, at_rest = robot.mj_model.jnt_stiffness.tolist(), robot.mj_model.qpos_spring.tolist()
    for number, joint, direction, anchor in axes:
        mass, j = masses[number], joint.index
        if joint.hinge:
            arm = subtract(sums[number], [multiply(x, mass) for x in anchor])
            held = dot(arm, cross(direction, gravity))
        else:
            held = multiply(dot(direction, gravity), -mass)
        spring = multiply(q[..., j] - at_rest[j], stiffness[j])
        torques[j] = add(held, spring)
    return torques


def _weights(robot: Robot) -> tuple[list[float], list[list[float]]]:
    """Mass [kg] of each body, less what carries itself, and that times its middle, in its frame;
    those of bodies without a joint are with the body that they hang on."""
    model = robot.mj_model
    masses = model.body_mass[1:] * (1 - model.body_gravcomp[1:])
    moments = masses[:, None] * model.body_ipos[1:]
    for number, body in reversed([*enumerate(robot.bodies)]):
        if not body.joints and body.parent >= 0:
            masses[body.parent] += masses[number]
            moments[body.parent] += body.rotation @ moments[number] + masses[number] * body.position
            masses[number], moments[number] = 0.0, 0.0
    return masses.tolist(), moments.tolist()
