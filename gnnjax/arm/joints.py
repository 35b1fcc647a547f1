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

from gnnjax.arm.couplings import Couplings, find_couplings, joints_of
from gnnjax.errors import InputError, perhaps

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
MOVED = (_HINGE, _SLIDE)  # by one value; free and ball joints are held as they are
_EQ_JOINT = int(mujoco.mjtEq.mjEQ_JOINT)
_EQ_TENDON = int(mujoco.mjtEq.mjEQ_TENDON)
_SAME = 1e-6  # rad or m
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
            neither in `hold` nor coupled to others by an equality, a tendon or a loop, but for
            slides without limits, most of which place a base.
        hold: values, in rad or m, by name. Others that are not planned for are held where the
            keyframe "home" has them, or at their reference, or where their coupling puts them.

    Raises:
        InputError: an unknown or doubled name, another order, a value beyond the limits, a joint
            without those that it is coupled to, or held without those that it is tied to.
    """
    names = [joint_name(model, j) for j in range(model.njnt)]
    if unknown := [name for name in (*(joints or ()), *hold) if name not in names]:
        meant = perhaps(unknown[0], names)
        raise InputError(f"no joint {unknown[0]!r} in {str(path)!r}{meant}; there are {names}")
    if joints is not None:
        chosen = [names.index(name) for name in joints]
        if not chosen:
            raise InputError(f"joints is {list(joints)}; name those to plan for, of {names}")
        if chosen != sorted(set(chosen)):
            order = [name for name in names if name in joints]
            raise InputError(f"joints is {list(joints)}; name each once, in the order {order}")
        if both := [name for name in joints if name in hold]:
            raise InputError(f"joint {both[0]!r} is to be planned for and held; name it once")
    couplings = find_couplings(model)
    if joints is None:
        coupled = couplings.joints
        chosen = [j for j in range(model.njnt) if names[j] not in hold and j not in coupled]
        endless = endless_slides(model)
        chosen = [j for j in chosen if j not in endless] or chosen
        if model.njnt and not chosen:
            raise InputError(
                f"all joints of {str(path)!r} are held or coupled to others; name those to plan "
                f"for with joints=[...], of {names}"
            )
    _check_coupled(couplings, path, names, {*chosen}, {names.index(name) for name in hold})
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    rest = model.key_qpos[key] if key >= 0 else model.qpos0
    held: dict[int, float] = {}
    for j in range(model.njnt):
        if j in chosen:
            continue
        held[j] = 0.0
        if int(model.jnt_type[j]) in MOVED:
            held[j] = float(rest[model.jnt_qposadr[j]])
            if model.jnt_limited[j]:
                held[j] = float(np.clip(held[j], *model.jnt_range[j]))
        elif names[j] in hold:
            raise InputError(f"joint {names[j]!r} is a free or ball joint; it is held as it is")
    for name, value in hold.items():
        j = names.index(name)
        lower, upper = model.jnt_range[j] if model.jnt_limited[j] else (-math.inf, math.inf)
        if not math.isfinite(value):
            raise InputError(f"joint {name!r} is to be held at {value:g}; give a finite number")
        if not lower - 1e-6 <= value <= upper + 1e-6:
            raise InputError(
                f"joint {name!r} is to be held at {value:g}; it must lie between {lower:g} and "
                f"{upper:g}"
            )
        held[j] = float(value)
    if restless := _follow(model, couplings.drivers, held, {names.index(name) for name in hold}):
        name = names[restless[0]]
        raise InputError(
            f"joint {name!r} of {str(path)!r} follows joints that follow it, and none is where the "
            f"others have it; give a value, hold={{{name!r}: ...}}"
        )
    return Choice(chosen, held)


def endless_slides(model: mujoco.MjModel) -> list[int]:
    """The slides without limits, by id: what they move can be planned for nowhere in particular."""
    return np.flatnonzero((model.jnt_type == _SLIDE) & (model.jnt_limited == 0)).tolist()


def _check_coupled(
    couplings: Couplings, path: Path, names: list[str], chosen: set[int], fixed: set[int]
) -> None:
    """Refuses joints to plan for, and values to hold some at, that couplings do not allow."""
    drivers = couplings.drivers
    for j, (driver, _) in drivers.items():
        if {j, driver} <= chosen:
            raise InputError(
                f"joint {names[j]!r} of {str(path)!r} follows {names[driver]!r}; plan for one of "
                "them at most"
            )
    for tie in couplings.ties:
        if len(both := sorted(tie & chosen)) > 1:
            raise InputError(
                f"joints {names[both[0]]!r} and {names[both[1]]!r} of {str(path)!r} are tied by an "
                "equality of tendons, or of bodies that closes a loop; plan for one of them at "
                'most, or take it out (active="false")'
            )
    pairs = [{j, driver} for j, (driver, _) in drivers.items() if driver >= 0]
    for group in (*pairs, *couplings.ties, *couplings.pulled):
        open_ones = sorted(group - chosen - fixed)
        for j in sorted(group & chosen) if open_ones else ():
            # They move along, and what they carry would be planned for where it is not.
            raise InputError(
                f"joint {names[j]!r} of {str(path)!r} is coupled to {names[open_ones[0]]!r}, which "
                "planning would leave where it is; if it stays there, "
                f"hold={{{names[open_ones[0]]!r}: ...}}, else leave {names[j]!r} out of joints"
            )
    followers = {*fixed}
    for _ in drivers:  # chains of them
        followers |= {j for j, (driver, _) in drivers.items() if driver in followers}
    for tie in couplings.ties:
        open_ones = sorted(tie - chosen - followers)
        for j in sorted(tie & fixed) if open_ones else ():
            raise InputError(
                f"joint {names[j]!r} of {str(path)!r} is to be held and is tied to "
                f"{names[open_ones[0]]!r}, which would stay at home; hold that, too, where it is "
                f"then: hold={{{names[open_ones[0]]!r}: ...}}"
            )


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
        if int(model.jnt_type[j]) not in MOVED:
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
    tendons = {t for t in range(model.ntendon) if joints_of(model, t) & set(held)}
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
