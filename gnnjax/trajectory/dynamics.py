"""Inverse dynamics as straight-line code, generated from a robot's constants.

Recursive Newton-Euler (Featherstone 2008, ch. 5) on components, like `arm/kinematics.py`, all seen
from the base. Velocities or gravity that are the constant zero leave no code behind.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from gnnjax.arm.bodies import Body, Joint
from gnnjax.arm.kinematics import (
    WORLD,
    Frame,
    Joints,
    Scalar,
    Vector,
    add,
    body_frames,
    cross,
    dot,
    joint_terms,
    move_joint,
    multiply,
    product,
    subtract,
    transform_point,
)
from gnnjax.arm.parts import quat_to_matrix
from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import inverse_dynamics_by_mujoco
from gnnjax.errors import InputError

_SAME = 1e-6  # relative; double precision agrees to 1e-12, single would to 1e-4
_STATES = 4  # at which own dynamics are compared with MuJoCo's


class PathDynamics(NamedTuple):
    """Torques along a path: `inertia * u + speed * x + rest`, and `damping * sqrt(x)` for what is
    viscous; u the path's acceleration, x its squared speed."""

    inertia: Float[Array, "*batch D"]
    speed: Float[Array, "*batch D"]
    rest: Float[Array, "*batch D"]  # gravity and springs, N m or N
    damping: Float[Array, "*batch D"]


class _Motion(NamedTuple):
    """How a frame moves: its turning, and the acceleration of its origin."""

    turning: Vector  # rad/s
    change: Vector  # of the turning, rad/s^2
    acceleration: Vector  # m/s^2


class _Axis(NamedTuple):
    """Where a joint is."""

    joint: Joint
    direction: Vector
    anchor: Vector


def path_dynamics(
    robot: Robot,
    q: Float[Array, "*batch D"],
    slope: Float[Array, "*batch D"],
    bend: Float[Array, "*batch D"],
) -> PathDynamics:
    """Torques along a path through q with first and second derivatives `slope` and `bend`."""
    still, model = [0.0] * robot.num_dof, robot.mj_model
    frames = _frames(robot, q)
    first, second = _components(slope), _components(bend)
    return PathDynamics(
        _newton_euler(robot, frames, q, still, first, gravity=False) + model.dof_armature * slope,
        _newton_euler(robot, frames, q, first, second, gravity=False) + model.dof_armature * bend,
        _newton_euler(robot, frames, q, still, still, gravity=True) + _springs(robot, q),
        model.dof_damping * slope,
    )


def inverse_dynamics(
    robot: Robot,
    q: Float[Array, "*batch D"],
    velocity: Float[Array, "*batch D"],
    acceleration: Float[Array, "*batch D"],
) -> Float[Array, "*batch D"]:
    """Torques [N m or N] that motors exert, as `mj_inverse` has them, dry friction left out."""
    model = robot.mj_model
    moving = _newton_euler(
        robot,
        _frames(robot, q),
        q,
        _components(velocity),
        _components(acceleration),
        gravity=True,
    )
    passive = _springs(robot, q) + model.dof_damping * velocity
    return moving + model.dof_armature * acceleration + passive


@functools.cache
def check_dynamics(robot: Robot) -> None:
    """Refuses arms that are moved by what is not computed here.

    Raises:
        InputError: MuJoCo's inverse dynamics, contacts and dry friction left out, are others.
    """
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (_STATES, robot.num_dof))
    velocity, acceleration = rng.normal(size=(2, _STATES, robot.num_dof))
    wanted = inverse_dynamics_by_mujoco(robot, q, velocity, acceleration)
    wanted -= robot.mj_model.dof_frictionloss * np.sign(velocity)
    with jax.enable_x64(True):  # step by step: compiling would take ten times as long
        found = np.asarray(inverse_dynamics(robot, *map(jnp.asarray, (q, velocity, acceleration))))
    scale = 1e-6 + np.abs(wanted).max()
    if not np.abs(found - wanted).max() <= _SAME * scale:
        joint = int(np.abs(found - wanted).max(axis=0).argmax())
        raise InputError(
            f"joint {robot.joint_names[joint]} of {robot.name} is moved by other forces than "
            "inertia, gravity, linear springs and damping (tendons, fluids, equalities), or lacks "
            "some of these (by <flag>); take the others, and the flags, out of the model"
        )


def _frames(robot: Robot, q: jax.Array) -> list[Frame]:
    return body_frames(robot, joint_terms(robot, q), settle=_settled)


def _settled(parts: Any) -> Any:
    """Keeps the compiler from computing components anew wherever they are used; constants stay."""
    leaves, tree = jax.tree.flatten(parts)
    arrays = iter(jax.lax.optimization_barrier([x for x in leaves if not isinstance(x, float)]))
    return jax.tree.unflatten(tree, [x if isinstance(x, float) else next(arrays) for x in leaves])


def _components(values: jax.Array) -> list[Scalar]:
    return list(jnp.moveaxis(values, -1, 0))


def _springs(robot: Robot, q: jax.Array) -> jax.Array:
    model = robot.mj_model
    return model.jnt_stiffness * (q - model.qpos_spring)


def _newton_euler(
    robot: Robot,
    frames: list[Frame],
    q: jax.Array,
    velocity: list[Scalar],
    acceleration: list[Scalar],
    *,
    gravity: bool,
) -> jax.Array:
    """Torques `[*batch D]`, without what joints have themselves: armature, springs, damping."""
    model, still = robot.mj_model, _Motion([0.0] * 3, [0.0] * 3, [0.0] * 3)
    joints = joint_terms(robot, q)
    motions: list[_Motion] = []
    wrenches: list[tuple[Vector, Vector]] = []  # force, moment about the base
    axes: list[list[_Axis]] = []
    for number, body in enumerate(robot.bodies, start=1):
        place, before = (
            (frames[body.parent], motions[body.parent]) if body.parent >= 0 else (WORLD, still)
        )
        motion, own_axes = _carried(
            body, place, frames[number - 1], before, joints, velocity, acceleration
        )
        motion = _settled(motion)
        motions.append(motion)
        axes.append(own_axes)
        pull = model.opt.gravity * (1 - model.body_gravcomp[number]) if gravity else np.zeros(3)
        wrench = _wrench(model, number, frames[number - 1], motion, pull.tolist())
        wrenches.append(_settled(wrench))
    torques: list[Scalar] = [0.0] * robot.num_dof
    for number in reversed(range(len(robot.bodies))):
        force, moment = wrenches[number]
        for axis in axes[number]:
            if axis.joint.hinge:
                about = subtract(moment, cross(axis.anchor, force))
                torques[axis.joint.index] = dot(axis.direction, about)
            else:
                torques[axis.joint.index] = dot(axis.direction, force)
        parent = robot.bodies[number].parent
        if parent >= 0:
            both = tuple(_sum(x, y) for x, y in zip(wrenches[parent], (force, moment), strict=True))
            wrenches[parent] = _settled(both)
    shape = q.shape[:-1]
    return jnp.stack([jnp.broadcast_to(jnp.asarray(t, q.dtype), shape) for t in torques], axis=-1)


def _carried(
    body: Body,
    parent: Frame,
    own: Frame,
    before: _Motion,
    joints: Joints,
    velocity: list[Scalar],
    acceleration: list[Scalar],
) -> tuple[_Motion, list[_Axis]]:
    """How a body moves, given how its parent does, and where its joints are."""
    position, rotation = parent
    origin = transform_point(position, rotation, body.position.tolist())
    at = _at(before, subtract(origin, position))
    turned = product(rotation, body.rotation.tolist())
    turning, change = before.turning, before.change
    axes: list[_Axis] = []
    for number, joint in enumerate(body.joints):
        # Its own turn leaves a joint's axis alone, those of joints before it on the body do not.
        if number:
            origin, turned = move_joint(body.joints[number - 1], origin, turned, joints)
        direction = [dot(row, joint.axis.tolist()) for row in turned]
        speed, push = velocity[joint.index], acceleration[joint.index]
        anchor = transform_point(origin, turned, joint.anchor.tolist())
        axes.append(_Axis(joint, direction, anchor))
        now = _Motion(turning, change, at)
        along, pushed = _scaled(direction, speed), _scaled(direction, push)
        if joint.hinge:
            at_anchor = _at(now, subtract(anchor, origin))
            change = _sum(_sum(change, pushed), cross(turning, along))
            turning = _sum(turning, along)
            end = (
                own[0] if joint is body.joints[-1] else move_joint(joint, origin, turned, joints)[0]
            )
            at = _at(_Motion(turning, change, at_anchor), subtract(end, anchor))
        else:
            at = _at(now, _scaled(direction, joints.values[joint.index]))
            twist = cross(turning, along)
            at = _sum(_sum(at, pushed), _sum(twist, twist))
    return _Motion(turning, change, at), axes


def _wrench(
    model: mujoco.MjModel, number: int, frame: Frame, motion: _Motion, gravity: list[float]
) -> tuple[Vector, Vector]:
    """Force and moment about the base that move a body."""
    mass = float(model.body_mass[number])
    if mass == 0.0:
        return [0.0] * 3, [0.0] * 3
    position, rotation = frame
    center = transform_point(position, rotation, model.body_ipos[number].tolist())
    fall = subtract(_at(motion, subtract(center, position)), gravity)
    force = _scaled(fall, mass)
    # The principal axes of inertia, seen from the base.
    axes = product(rotation, quat_to_matrix(model.body_iquat[number]).tolist())
    inertia = model.body_inertia[number].tolist()

    def times(vector: Vector) -> Vector:
        inside = [dot(column, vector) for column in zip(*axes, strict=True)]
        inside = [multiply(x, i) for x, i in zip(inside, inertia, strict=True)]
        return [dot(row, inside) for row in axes]

    spin = _sum(times(motion.change), cross(motion.turning, times(motion.turning)))
    return force, _sum(spin, cross(center, force))


def _at(motion: _Motion, offset: Vector) -> Vector:
    """The acceleration of a point of a frame."""
    turned = cross(motion.turning, cross(motion.turning, offset))
    return _sum(motion.acceleration, _sum(cross(motion.change, offset), turned))


def _sum(a: Vector, b: Vector) -> Vector:
    return [add(x, y) for x, y in zip(a, b, strict=True)]


def _scaled(vector: Vector, by: Scalar) -> Vector:
    return [multiply(x, by) for x in vector]
