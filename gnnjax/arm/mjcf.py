"""Models of arms: moved to the frame of their base; refused where planning would misjudge them."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gnnjax.arm.joints import joint_name
from gnnjax.errors import InputError

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)

# Flags of an MJCF that would hide contacts from the C engine.
HIDING = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
# Of a joint's range, rad or m: sixteen turns. The tables of points along an edge grow with it.
_MOST_RANGE = 100.0
_MOST_METERS = 1e4  # of any length of an arm; single precision has lost a millimetre there
_PLAIN = {  # geoms
    "pos": [0.0, 0.0, 0.0],
    "quat": [1.0, 0.0, 0.0, 0.0],
    "group": 0,
    "margin": 0.0,
    "gap": 0.0,
    "priority": 0,
}


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """In here MuJoCo's warnings go nowhere: by itself it writes them into the user's folder.

    What they are about, such as NaN, is refused where it matters.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def move_to_base(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Moves the world of a spec to the frame of the arm's base.

    The base is the body of the worldbody that carries all joints and is not moved by one. Where
    there is none, as for two arms or a first link that hangs in the world itself, it is the world.

    Args:
        spec: changed in place.
        model: compiled from it as it is.
    """
    roots = set(model.body_rootid[model.jnt_bodyid].tolist())
    base = roots.pop() if len(roots) == 1 else 0
    if model.body_jntnum[base]:
        base = 0
    position, quat = model.body_pos[base], model.body_quat[base]
    if not position.any() and (quat == [1, 0, 0, 0]).all():
        return  # not even rounded
    # The world seen from the base.
    turned, moved, gravity = np.zeros(4), np.zeros(3), np.zeros(3)
    mujoco.mju_negQuat(turned, quat)
    mujoco.mju_rotVecQuat(moved, -position, turned)
    mujoco.mju_rotVecQuat(gravity, spec.option.gravity, turned)
    world = spec.worldbody
    frame = world.add_frame(pos=moved, quat=turned)
    placed = (world.bodies, world.geoms, world.sites, world.cameras, world.lights, world.frames)
    for element in (x for elements in placed for x in elements):
        # What has a frame already is moved along with it.
        if element.frame is None and element is not frame:
            element.set_frame(frame)
    spec.option.gravity = gravity


def keep_inertias(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Writes the inertias down that MuJoCo has found: from geoms, say, or to make up a total."""
    for body in spec.bodies:
        if body.id and model.body_mass[body.id] > 0:
            body.explicitinertial = True
            body.mass = float(model.body_mass[body.id])
            body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
            body.inertia = model.body_inertia[body.id]
            body.fullinertia = np.full(6, np.nan)  # none


def add_geom(body: mujoco.MjsBody, **how: Any) -> mujoco.MjsGeom:
    """Adds a geom that is just as it is given, whatever `<default>` has the file's own geoms be."""
    geom = body.add_geom(**_PLAIN | how)
    geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    geom.fromto = np.full(6, np.nan)  # none
    return geom


def check_numbers(model: mujoco.MjModel, path: Path) -> None:
    """Refuses an MJCF with numbers that no kernel can compute with; MuJoCo takes them.

    Raises:
        InputError: a number that is not finite, or a length beyond 10 km.
    """
    lengths = ("body_pos", "jnt_pos", "geom_pos", "geom_size")
    for name in (*lengths, "body_quat", "jnt_axis", "geom_quat", "qpos0"):
        values = getattr(model, name)
        bad = ~np.isfinite(values)
        if name in lengths:
            bad |= np.abs(values) > _MOST_METERS
        if bad.any():
            raise InputError(
                f"{name} of {str(path)!r} holds {values[bad][0]}; all of an arm's numbers must be "
                f"finite, and its lengths below {_MOST_METERS:g} m"
            )


def check_joints(model: mujoco.MjModel, path: Path) -> None:
    """Refuses joints that planning cannot move.

    Raises:
        InputError: no joint, one that is neither hinge nor slide, or limits that bound nothing.
    """
    if not model.njnt:
        raise InputError(f"{str(path)!r} has no joints; planning needs at least one")
    for j in range(model.njnt):
        name = joint_name(model, j)
        if int(model.jnt_type[j]) not in (_HINGE, _SLIDE):
            raise InputError(
                f"joint {name} of {str(path)!r} is a free or ball joint; "
                "planning supports hinge and slide joints (name those to plan for: joints=[...])"
            )
        if not model.jnt_limited[j]:
            raise InputError(
                f'joint {name} of {str(path)!r} has no limits; give it range="lower upper", or '
                f"hold it, hold={{{name!r}: ...}}"
            )
        lower, upper = model.jnt_range[j].astype(np.float32)
        if not 0 < upper - lower <= _MOST_RANGE:  # NaN and infinity fail this, too
            raise InputError(
                f"joint {name} of {str(path)!r} has the range {lower:g} to {upper:g}; the second "
                f"must be larger in single precision, by at most {_MOST_RANGE:g} rad (or m)"
            )


def collision_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Ids of the geoms that MuJoCo collides with anything."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    collides[model.pair_geom1] = collides[model.pair_geom2] = True
    return np.flatnonzero(collides)


def soft_bodies(model: mujoco.MjModel) -> list[str]:
    """Names of the flexes (cloths, soft bodies) that MuJoCo collides with anything."""
    collides = (model.flex_contype != 0) | (model.flex_conaffinity != 0)
    flex = mujoco.mjtObj.mjOBJ_FLEX
    return [mujoco.mj_id2name(model, flex, f) or "" for f in np.flatnonzero(collides).tolist()]


def links_never_meet(model: mujoco.MjModel) -> bool:
    """Whether the bits of the collision geoms, meant for other things than the arm, pair none of
    its links though there are some that could meet."""
    geoms = collision_geoms(model)
    return not len(self_pairs(model, geoms)) and len(self_pairs(model, geoms, bits=False)) > 0


def self_pairs(model: mujoco.MjModel, geom_ids: np.ndarray, *, bits: bool = True) -> np.ndarray:
    """Pairs `[Q 2]` of the given geoms that MuJoCo would test: its filters, restated.

    Geoms are paired when their bits match, unless these do not count, and they belong to different
    welded bodies that are neither parent and child (unless the parent is the world) nor an excluded
    pair. What `<contact><pair>` names is paired whatever those filters say.
    """
    weld, parent = model.body_weldid, model.body_parentid
    signatures = set(model.exclude_signature.tolist())
    filter_parent = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    row = {int(g): i for i, g in enumerate(geom_ids)}
    pairs = {
        tuple(sorted((row[a], row[b])))
        for a, b in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    }
    for i, first in enumerate(geom_ids):
        for j, second in enumerate(geom_ids[i + 1 :], start=i + 1):
            a, b = sorted((int(model.geom_bodyid[first]), int(model.geom_bodyid[second])))
            wa, wb = int(weld[a]), int(weld[b])
            if wa == wb or (a << 16) + b in signatures:
                continue
            if filter_parent and wa and wb and weld[parent[wb]] == wa:
                continue
            if filter_parent and wa and wb and weld[parent[wa]] == wb:
                continue
            if not bits or (
                (model.geom_contype[first] & model.geom_conaffinity[second])
                | (model.geom_contype[second] & model.geom_conaffinity[first])
            ):
                pairs.add((i, j))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
