"""Reads an arm from MJCF or URDF: the joints that are planned for, seen from the arm's base."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.contacts import pair_explicitly
from gnnjax.arm.joints import MOVED, choose_joints, endless_slides, hold_joints, joint_name
from gnnjax.arm.mjcf import (
    check_numbers,
    collision_geoms,
    keep_inertias,
    links_never_meet,
    move_to_base,
    self_pairs,
    soft_bodies,
)
from gnnjax.arm.parts import geom_name
from gnnjax.arm.sources import check_meshes
from gnnjax.arm.urdf import read_urdf
from gnnjax.errors import InputError

ONE_TURN = 2 * math.pi + 1e-5  # rad; a range beyond is of a joint that turns more than once
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_NO_FRICTION = int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
_TRN_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
# What stands for the surroundings where it is fixed to the world.
_GROUND = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
    int(mujoco.mjtGeom.mjGEOM_HFIELD): "height field",
}


class Reading(NamedTuple):
    """An arm of D joints, as its file has it."""

    spec: mujoco.MjSpec  # of the planned joints alone; "the world" is the arm's base
    held: dict[str, float]  # joints that are not planned for, rad or m; 0: free and ball joints
    fixed: tuple[tuple[str, float], ...]  # the hinges and slides among them, sorted
    by_itself: bool  # whether all joints are planned for and held as the file alone says
    home: np.ndarray | None  # [D] the keyframe "home"
    velocity_limit: np.ndarray | None  # [D] rad/s or m/s; None where one is not given
    acceleration_limit: np.ndarray | None  # [D] rad/s^2 or m/s^2
    torque_limit: np.ndarray | None  # [D] N m or N
    notes: tuple[str, ...]  # what was decided where the file leaves it open


def read_arm(path: Path, joints: Sequence[str] | None, hold: Mapping[str, float]) -> Reading:
    """Reads an arm; see `load_robot`.

    Raises:
        InputError: the file lacks what planning needs, or `joints` and `hold` do not fit it.
        ValueError: MuJoCo cannot read or compile it.
    """
    given, no_room, said = {}, {}, []
    if path.suffix == ".urdf":
        spec, given, no_room, said = read_urdf(path)
    else:
        check_meshes(path)
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False  # the base stays a body, and bodies keep their names
    model, notes = _plain(spec), said
    check_numbers(model, path)
    if soft := soft_bodies(model):
        raise InputError(
            f"flex {soft[0]!r} of {str(path)!r} is soft, which no arm can be here; remove it, or "
            'let it collide with nothing (<contact contype="0" conaffinity="0"/>)'
        )
    choice = choose_joints(model, path, joints, hold)
    default = None if joints is not None or hold else choice
    if default is None:
        with contextlib.suppress(InputError):  # by itself it is no arm that can be planned for
            default = choose_joints(model, path, None, {})
    by_itself = choice == default
    for name in (joint_name(model, j) for j in choice.planned):
        if name in no_room:
            lower, upper = no_room[name]
            raise InputError(
                f"joint {name} of {str(path)!r} has the range {lower:g} to {upper:g}; the second "
                f"must be larger (without limits: continuous), or hold it, hold={{{name!r}: ...}}"
            )
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    home = None
    if key >= 0:
        home = model.key_qpos[key, model.jnt_qposadr[choice.planned]].copy()
    listed = [list(range(model.njnt)), default.planned if default else [], choice.planned]
    velocities, accelerations = (
        _by_name(model, given[kind], choice.planned)
        if given
        else _numeric(model, path, f"{kind}_limit", listed, choice.planned)
        for kind in ("velocity", "acceleration")
    )
    limits = velocities, accelerations, _torques(model, choice.planned)

    endless = [
        j for j in choice.planned if int(model.jnt_type[j]) == _HINGE and not model.jnt_limited[j]
    ]
    for j, joint in ((joint.id, joint) for joint in spec.joints):
        if j in endless:
            turn = 360.0 if joint.compiler.degree else 2 * math.pi
            joint.range, joint.limited = [-turn, turn], mujoco.mjtLimited.mjLIMITED_TRUE
            if home is not None:
                index = choice.planned.index(j)
                home[index] = math.remainder(home[index], 2 * math.pi)
    if endless:
        names = ", ".join(joint_name(model, j) for j in endless)
        notes.append(
            "ways are looked for within half a turn either way of joints without limits, and "
            f"around start and goal, which may be a turn away: {names}"
        )
    still = [joint_name(model, j) for j in endless_slides(model) if j in choice.held]
    still = [name for name in still if joints is None and name not in hold]
    if still:
        notes.append(f"slides without limits are held where they are: {', '.join(still)}")
    turning = [
        j
        for j in choice.planned
        if int(model.jnt_type[j]) == _HINGE
        and model.jnt_limited[j]
        and np.ptp(model.jnt_range[j]) > ONE_TURN
    ]
    if turning:
        names = ", ".join(joint_name(model, j) for j in turning)
        notes.append(
            "ways are looked for within one turn of joints that turn by more, and around start and "
            f"goal, which may lie in any: {names}"
        )
    ground = [
        g
        for g in collision_geoms(model).tolist()
        if int(model.geom_type[g]) in _GROUND and not model.body_weldid[model.geom_bodyid[g]]
    ]
    apart = _kept_apart(spec, model, ground) if choice.held else []
    if ground:
        _remove_geoms(spec, model, set(ground))
        names = ", ".join(
            f"{_GROUND[int(model.geom_type[g])]} {geom_name(model, g)}" for g in ground
        )
        notes.append(f"no part of the arm, and left out: {names}; put it into the scene")
    if choice.held:
        hold_joints(spec, model, choice.held)
    held = {joint_name(model, j): value for j, value in choice.held.items()}
    kinds = {joint_name(model, j): int(model.jnt_type[j]) for j in choice.held}
    fixed = tuple(sorted((name, x) for name, x in held.items() if kinds[name] in MOVED))
    if open_ones := [f"{name} at {x:.4g}" for name, x in held.items() if name not in hold]:
        notes.append(f"joints that are not planned for are held: {', '.join(open_ones)}")
    if endless or ground or choice.held:
        model = spec.compile()
    # Held joints make neighbours of links that are none, and MuJoCo would let these pass.
    weld = model.body_weldid[model.geom_bodyid]
    moving = [(a.id, b.id) for a, b in apart if weld[a.id] != weld[b.id]]
    if moving and pair_explicitly(spec, model, np.array(moving)):
        model = spec.compile()
    if links_never_meet(model):
        for geom in spec.geoms:
            if model.geom_contype[geom.id] or model.geom_conaffinity[geom.id]:
                geom.contype, geom.conaffinity = 1, 1
        notes.append("contype and conaffinity let no two links meet; here all but neighbours do")
    move_to_base(spec, model)
    return Reading(spec, held, fixed, by_itself, home, *limits, tuple(notes))


def _kept_apart(
    spec: mujoco.MjSpec, model: mujoco.MjModel, ground: Sequence[int]
) -> list[tuple[mujoco.MjsGeom, mujoco.MjsGeom]]:
    """The pairs of geoms that MuJoCo tests, but for those of the ground."""
    geoms, by_id = collision_geoms(model), {geom.id: geom for geom in spec.geoms}
    pairs = geoms[self_pairs(model, geoms)].tolist()
    return [(by_id[a], by_id[b]) for a, b in pairs if not {a, b} & {*ground}]


def _remove_geoms(spec: mujoco.MjSpec, model: mujoco.MjModel, geoms: set[int]) -> None:
    pairs = list(spec.pairs)
    for pair, first, second in zip(pairs, model.pair_geom1, model.pair_geom2, strict=True):
        if geoms & {int(first), int(second)}:
            spec.delete(pair)
    for geom in [geom for geom in spec.geoms if geom.id in geoms]:  # ids change with each
        spec.delete(geom)


def _numeric(
    model: mujoco.MjModel, path: Path, name: str, listed: list[list[int]], planned: list[int]
) -> np.ndarray | None:
    """Numbers of the planned joints, from a `<numeric>`; None where one of them has none.

    Args:
        model: the whole arm.
        path: for messages.
        name: of the numeric.
        listed: joints that it may have a number for each of; the first list of its size counts.
        planned: joints whose numbers are asked for.

    Raises:
        InputError: another number of them, or one that is not positive.
    """
    numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if numeric < 0:
        return None
    begin, size = model.numeric_adr[numeric], model.numeric_size[numeric]
    values = model.numeric_data[begin : begin + size].astype(np.float32)
    order = next((some for some in listed if len(some) == size), None)
    if order is None or not ((values > 0) & np.isfinite(values)).all():
        counts = " or ".join(str(n) for n in sorted({len(some) for some in listed} - {0})[::-1])
        raise InputError(
            f"{name} in {str(path)!r} is {values.tolist()}; it needs {counts} positive numbers, "
            "one for each joint or for each that is planned for"
        )
    if not {*planned} <= {*order}:
        return None
    return values[[order.index(j) for j in planned]]


def _by_name(
    model: mujoco.MjModel, values: dict[str, float], planned: list[int]
) -> np.ndarray | None:
    """Numbers of the planned joints; None where one of them has none."""
    found = [values.get(joint_name(model, j)) for j in planned]
    return None if None in found else np.array(found, np.float32)


def motor_limits(model: mujoco.MjModel) -> np.ndarray:
    """What each joint of a model can exert either way, N m or N, by its own limits and those of its
    actuators; infinite where it has none, and 0 where one of them lets it push one way only."""
    limits = np.full(model.njnt, np.inf)
    for j in np.flatnonzero(model.jnt_actfrclimited):
        limits[j] = _either_way(model.jnt_actfrcrange[j])
    for a in range(model.nu):
        j, gear = int(model.actuator_trnid[a, 0]), abs(model.actuator_gear[a, 0])
        if int(model.actuator_trntype[a]) not in _TRN_JOINTS or not gear:
            continue
        ranges = [model.actuator_forcerange[a]] if model.actuator_forcelimited[a] else []
        if model.actuator_ctrllimited[a] and _is_motor(model, a):
            ranges.append(model.actuator_ctrlrange[a] * model.actuator_gainprm[a, 0])
        for force in ranges:
            limits[j] = min(limits[j], _either_way(force) * gear)
    return limits


def _either_way(force: np.ndarray) -> float:
    """The most that a range of forces has of both signs."""
    return max(0.0, min(-force.min(), force.max()))


def _is_motor(model: mujoco.MjModel, a: int) -> bool:
    """Whether an actuator's force is its control, times a constant."""
    fixed = model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
    plain = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
    return bool(fixed and plain and model.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_NONE)


def _plain(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a spec, from which it takes what would change what is added to the arm later: a mass
    that all is scaled to, and friction that a flag leaves out."""
    model = spec.compile()
    is_scaled = spec.compiler.settotalmass > 0
    is_smooth = bool(spec.option.disableflags & _NO_FRICTION)
    if is_scaled:
        spec.compiler.settotalmass = -1
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
        keep_inertias(spec, model)
    if is_smooth:
        spec.option.disableflags &= ~_NO_FRICTION
        for each in (*spec.joints, *spec.tendons):
            each.frictionloss = 0.0
    return spec.compile() if is_scaled or is_smooth else model


def _torques(model: mujoco.MjModel, planned: list[int]) -> np.ndarray | None:
    """Limits of the planned joints; None where one has none, or pushes one way only."""
    chosen = motor_limits(model)[planned]
    return chosen.astype(np.float32) if ((chosen > 0) & np.isfinite(chosen)).all() else None
