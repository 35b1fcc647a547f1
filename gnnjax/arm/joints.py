"""Which joints are planned for, and at what values the others are held.

Held joints leave the model: the pose of their body takes over what they did. So all that comes
after sees an arm of the planned joints alone.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.errors import InputError

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_EQ_JOINT = int(mujoco.mjtEq.mjEQ_JOINT)
_EQ_TENDON = int(mujoco.mjtEq.mjEQ_TENDON)
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_SAME = 1e-6  # rad or m
_WRAP_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)
_TRN_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_TRN_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


class Choice(NamedTuple):
    """The joints of a model, by id: each is planned for or held."""

    planned: list[int]
    held: dict[int, float]  # rad or m; 0 for joints that are neither hinge nor slide


def joint_name(model: mujoco.MjModel, j: int) -> str:
    """How messages call a joint."""
    return model.joint(j).name or f"number {j}"


def choose_joints(
    model: mujoco.MjModel,
    path: Path,
    joints: Sequence[str] | None,
    hold: Mapping[str, float],
) -> Choice:
    """Decides which joints are planned for.

    Args:
        model: the whole arm.
        path: for messages.
        joints: names of those to plan for, in the order of the model; by default all that are
            neither in `hold` nor coupled to others by an equality, a tendon or a loop.
        hold: values, in rad or m, by name. Others that are not planned for are held where the
            keyframe "home" has them, or at their reference, or where their coupling puts them.

    Raises:
        InputError: an unknown or doubled name, another order, a value beyond the limits, a joint
            without one that it is coupled to.
    """
    names = [joint_name(model, j) for j in range(model.njnt)]
    if unknown := [name for name in (*(joints or ()), *hold) if name not in names]:
        raise InputError(f"no joint {unknown[0]!r} in {str(path)!r}; there are {names}")
    if joints is not None:
        chosen = [names.index(name) for name in joints]
        if not chosen or chosen != sorted(set(chosen)):
            order = [name for name in names if name in joints]
            raise InputError(f"joints is {list(joints)}; name each once, in the order {order}")
        if both := [name for name in joints if name in hold]:
            raise InputError(f"joint {both[0]!r} is to be planned for and held; name it once")
    drivers, coupled = _couplings(model)
    if joints is None:
        chosen = [j for j in range(model.njnt) if names[j] not in hold and j not in coupled]
        if model.njnt and not chosen:
            raise InputError(
                f"all joints of {str(path)!r} are held or coupled to others; name those to plan "
                f"for with joints=[...], of {names}"
            )
    for j in chosen:
        if j in drivers and drivers[j][0] in chosen:
            raise InputError(
                f"joint {names[j]!r} of {str(path)!r} follows {names[drivers[j][0]]!r}; plan for "
                "one of them at most"
            )
    for j, (driver, _) in drivers.items():
        for one, other in ((j, driver), (driver, j)):
            if one in chosen and other >= 0 and names[other] not in hold:
                # It moves along, and what it carries would be planned for where it is not.
                raise InputError(
                    f"joint {names[one]!r} of {str(path)!r} is coupled to {names[other]!r}, which "
                    "planning would leave where it is; if it stays there, "
                    f"hold={{{names[other]!r}: ...}}, else leave {names[one]!r} out of joints"
                )
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    rest = model.key_qpos[key] if key >= 0 else model.qpos0
    held: dict[int, float] = {}
    for j in range(model.njnt):
        if j in chosen:
            continue
        held[j] = 0.0
        if int(model.jnt_type[j]) in (_HINGE, _SLIDE):
            held[j] = float(rest[model.jnt_qposadr[j]])
            if model.jnt_limited[j]:
                held[j] = float(np.clip(held[j], *model.jnt_range[j]))
        elif names[j] in hold:
            raise InputError(f"joint {names[j]!r} is a free or ball joint; it is held as it is")
    for name, value in hold.items():
        j = names.index(name)
        lower, upper = model.jnt_range[j] if model.jnt_limited[j] else (-math.inf, math.inf)
        if not (lower - 1e-6 <= value <= upper + 1e-6 and math.isfinite(value)):
            raise InputError(
                f"joint {name!r} is to be held at {value:g}; it must lie between {lower:g} and "
                f"{upper:g}"
            )
        held[j] = float(value)
    if restless := _follow(model, drivers, held, {names.index(name) for name in hold}):
        name = names[restless[0]]
        raise InputError(
            f"joint {name!r} of {str(path)!r} follows joints that follow it, and none is where the "
            f"others have it; give a value, hold={{{name!r}: ...}}"
        )
    return Choice(chosen, held)


def _follow(
    model: mujoco.MjModel,
    drivers: dict[int, tuple[int, np.ndarray]],
    held: dict[int, float],
    fixed: set[int],
) -> list[int]:
    """Puts held joints where their coupling has them, but for those with a value of their own;
    those that would go on moving are in a circle."""
    moved: list[int] = []
    for _ in range(len(drivers) + 1):  # chains of them
        moved = []
        for j, (driver, poly) in drivers.items():
            if j in held and j not in fixed and (driver < 0 or driver in held):
                x = 0.0 if driver < 0 else held[driver] - model.qpos0[model.jnt_qposadr[driver]]
                value = model.qpos0[model.jnt_qposadr[j]] + np.polyval(poly[::-1], x)
                if model.jnt_limited[j]:
                    value = np.clip(value, *model.jnt_range[j])
                if abs(value - held[j]) > _SAME:
                    moved.append(j)
                held[j] = float(value)
    return moved


def _couplings(
    model: mujoco.MjModel,
) -> tuple[dict[int, tuple[int, np.ndarray]], set[int]]:
    """The joint that each follower follows (-1: none, it is fixed) with the polynomial, and all
    joints that do not move by themselves."""
    drivers: dict[int, tuple[int, np.ndarray]] = {}
    coupled: set[int] = set()
    tendons = {
        int(model.actuator_trnid[a, 0])
        for a in range(model.nu)
        if int(model.actuator_trntype[a]) == _TRN_TENDON
    }
    for e in np.flatnonzero(model.eq_active0).tolist():
        first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        kind = int(model.eq_type[e])
        if kind == _EQ_JOINT:
            drivers[first] = second, model.eq_data[e, :5].copy()
            coupled |= {first, second} - {-1}
        elif kind == _EQ_TENDON:
            tendons |= {first, second} - {-1}
        elif kind in _LOOPS:
            coupled |= _loop(model, e)
    for tendon in tendons:
        coupled |= _joints_of(model, tendon)
    return drivers, coupled


def _joints_of(model: mujoco.MjModel, tendon: int) -> set[int]:
    """The joints whose values a tendon adds up; none where it runs through space."""
    first = int(model.tendon_adr[tendon])
    wraps = range(first, first + int(model.tendon_num[tendon]))
    return {int(model.wrap_objid[w]) for w in wraps if int(model.wrap_type[w]) == _WRAP_JOINT}


def _loop(model: mujoco.MjModel, e: int) -> set[int]:
    """The joints between two bodies that an equality ties together; none where one of them is
    fixed to the world, or carried by hand (mocap), which ties the arm and not its gripper."""
    ends = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])]
    if int(model.eq_objtype[e]) == int(mujoco.mjtObj.mjOBJ_SITE):
        ends = [int(model.site_bodyid[s]) for s in ends]
    chains = []
    for body in ends:
        chain = set()
        if not model.body_weldid[body]:
            return set()
        while body:
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            chain |= set(range(first, first + count))
            body = int(model.body_parentid[body])
        chains.append(chain)
    return chains[0] ^ chains[1]


def hold_joints(spec: mujoco.MjSpec, model: mujoco.MjModel, held: Mapping[int, float]) -> None:
    """Takes held joints out of a spec, and with them all that refers to them, sensors and
    keyframes.

    Args:
        spec: changed in place; it has to be compiled again.
        model: compiled from it as it is.
        held: values by joint id.

    Raises:
        InputError: a held joint comes after another one of its body, which stands in a frame.
    """
    bodies = {body.id: body for body in spec.bodies}
    joints = {joint.id: joint for joint in spec.joints}
    anchors, axes = model.jnt_pos.copy(), model.jnt_axis.copy()
    for j in sorted(held):
        if int(model.jnt_type[j]) not in (_HINGE, _SLIDE):
            continue  # its body stays where the model has it
        moved, turned = _motion(model, j, anchors[j], axes[j], held[j])
        body = bodies[int(model.jnt_bodyid[j])]
        quat = spec.resolve_orientation(
            degree=body.compiler.degree, sequence=body.compiler.eulerseq, orientation=body.alt
        )
        if body.alt.type == mujoco.mjtOrientation.mjORIENTATION_QUAT:
            quat = body.quat
        quat = np.array(quat, float) / np.linalg.norm(quat)
        body.pos = np.array(body.pos) + _rotated(moved, quat)
        body.quat = _product(quat, turned)
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        # Joints of the same body that come before are now seen from where this one put it.
        back = turned * [1, -1, -1, -1]
        for k in range(int(model.body_jntadr[body.id]), j):
            if k in held:
                continue
            if joints[k].frame is not None:
                raise InputError(
                    f"joint {joint_name(model, k)} stands in a <frame> and before the held joint "
                    f"{joint_name(model, j)} of the same body; take it out of the frame"
                )
            anchors[k] = _rotated(anchors[k] - moved, back)
            axes[k] = _rotated(axes[k], back)
            joints[k].pos, joints[k].axis = anchors[k], axes[k]
    tendons = {t for t in range(model.ntendon) if _joints_of(model, t) & set(held)}
    gone = [
        *(x for x in spec.equalities if _equality_refers(model, x.id, held, tendons)),
        *(x for x in spec.actuators if _actuator_refers(model, x.id, held, tendons)),
        *spec.sensors,
        *spec.keys,
        *(x for x in spec.tendons if x.id in tendons),
        *(joints[j] for j in held),
    ]
    for element in gone:
        spec.delete(element)


def _motion(
    model: mujoco.MjModel, j: int, anchor: np.ndarray, axis: np.ndarray, value: float
) -> tuple[np.ndarray, np.ndarray]:
    """How a joint at a value moves its body, in the body's frame: m, and a quaternion."""
    value = value - float(model.qpos0[model.jnt_qposadr[j]])
    if int(model.jnt_type[j]) == _SLIDE:
        return axis * value, np.array([1.0, 0.0, 0.0, 0.0])
    quat = np.empty(4)
    mujoco.mju_axisAngle2Quat(quat, axis, value)
    return anchor - _rotated(anchor, quat), quat


def _rotated(vector: np.ndarray, quat: np.ndarray) -> np.ndarray:
    result = np.empty(3)
    mujoco.mju_rotVecQuat(result, vector, quat)
    return result


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    result = np.empty(4)
    mujoco.mju_mulQuat(result, first, second)
    return result


def _equality_refers(
    model: mujoco.MjModel, e: int, held: Mapping[int, float], tendons: set[int]
) -> bool:
    ends = {int(model.eq_obj1id[e]), int(model.eq_obj2id[e])}
    kind = int(model.eq_type[e])
    return bool((kind == _EQ_JOINT and ends & set(held)) or (kind == _EQ_TENDON and ends & tendons))


def _actuator_refers(
    model: mujoco.MjModel, a: int, held: Mapping[int, float], tendons: set[int]
) -> bool:
    kind, target = int(model.actuator_trntype[a]), int(model.actuator_trnid[a, 0])
    return (kind in _TRN_JOINTS and target in held) or (kind == _TRN_TENDON and target in tendons)
