"""What an arm can hold: its kinds, their covers and masses, and MuJoCo's body of them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.blocks import box_cover, cylinder_cover
from gnnjax.arm.covers import OVERSHOOT, chain_cover
from gnnjax.arm.fit import Cover
from gnnjax.arm.mjcf import add_geom
from gnnjax.arm.parts import Part, quat_to_matrix
from gnnjax.errors import InputError, brief
from gnnjax.scene.numbers import check_shapes, sums_from, unit_quats
from gnnjax.scene.pose import IDENTITY, Pose, compose
from gnnjax.scene.shapes import KINDS, for_every_kind

_ALL_BITS = -1  # of contype and conaffinity: it meets whatever bits the arm's author chose


class _Kind(NamedTuple):
    geom: mujoco.mjtGeom
    volume: Callable[[np.ndarray], float]  # m^3, of MuJoCo's sizes [3]
    cover: Callable[[np.ndarray, Part], Cover]  # in the shape's own frame


def _cover_of_cylinder(size: np.ndarray, part: Part) -> Cover:
    around = float(np.linalg.norm(part.vertices[:, :2], axis=1).max())
    return cylinder_cover(float(size[0]), float(size[1]), around, OVERSHOOT)


_HELD = for_every_kind(
    "held object",
    box=_Kind(
        mujoco.mjtGeom.mjGEOM_BOX,
        lambda size: 8 * float(size.prod()),
        lambda size, part: box_cover(size, OVERSHOOT),
    ),
    sphere=_Kind(
        mujoco.mjtGeom.mjGEOM_SPHERE,
        lambda size: 4 / 3 * np.pi * float(size[0]) ** 3,
        lambda size, part: chain_cover(part),
    ),
    capsule=_Kind(
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        lambda size: np.pi * float(size[0]) ** 2 * float(2 * size[1] + 4 / 3 * size[0]),
        lambda size, part: chain_cover(part),
    ),
    cylinder=_Kind(
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        lambda size: np.pi * float(size[0]) ** 2 * float(2 * size[1]),
        _cover_of_cylinder,
    ),
    half_space=None,  # nobody holds one
)


class Item(NamedTuple):
    """One shape that is held."""

    kind: str
    pose: Pose  # in the frame of the body that holds it
    size: np.ndarray  # [3] m, as MuJoCo has them

    def cover(self, part: Part) -> Cover:
        """Spheres around the part that it became, in the frame of the body that holds it."""
        turn = quat_to_matrix(self.pose.quat)
        # The shape's own frame.
        own = part._replace(vertices=(part.vertices - self.pose.position) @ turn)
        found = _HELD[self.kind].cover(self.size, own)
        return found._replace(centers=found.centers @ turn.T + self.pose.position)


def pose_from(pose: Sequence | None) -> Pose:
    """A pose as people give it, or what is wrong with it."""
    if pose is None:
        return IDENTITY
    try:
        position, quat = (np.asarray(x, float) for x in pose)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"pose is {brief(pose)}; give a position and a quaternion") from None
    good = position.shape == (3,) and quat.shape == (4,) and np.isfinite([*position, *quat]).all()
    if not good or np.abs(quat).max() < 1e-3:
        raise InputError(
            f"pose is {brief(pose)}; give a position (3 numbers, m) and a quaternion (w x y z)"
        )
    return Pose(position, unit_quats(quat))


def items_from(shapes: Sequence, pose: Pose, body: str) -> list[Item]:
    """Shapes as MuJoCo has them, in the frame of the body."""
    check_shapes(shapes, "shapes")
    if not shapes:
        raise InputError(f"shapes is empty; name what {body} holds, or keep the arm as it is")
    items = []
    for kind in KINDS:
        chosen = [x.values for x in shapes if x.kind == kind]
        if not chosen:
            continue
        if _HELD[kind] is None:
            raise InputError(f"{body} is to hold a {kind}, which has no end; give a box")
        columns = {name: [values[name] for values in chosen] for name in chosen[0]}
        for center, half_extents, quat, radii in zip(
            *sums_from(kind, columns, f"what {body} holds"), strict=True
        ):
            radius = radii.sum()  # of disc and ball, one of which is zero
            size = np.array([radius, half_extents[2], 0.0]) if radius > 0 else half_extents
            items.append(Item(kind, compose(pose, Pose(center, quat)), size))
    return items


def add_body(
    spec: mujoco.MjSpec, holder: str, name: str, items: list[Item], mass: float | None
) -> list[str]:
    """Adds to a spec a body of what is held; returns the names of its geoms."""
    if mass is not None and not 0 < mass < np.inf:
        raise InputError(f"mass is {mass}; it must be positive (kg), or left out")
    used = {geom.name for geom in spec.geoms}
    body = spec.body(holder).add_body(name=name)
    # By itself, as the compiler of the arm's file may not take masses from geoms.
    alone = mujoco.MjSpec()
    weighed = alone.worldbody.add_body()
    volumes = [_HELD[item.kind].volume(item.size) for item in items]
    names = []
    for item, volume in zip(items, volumes, strict=True):
        number = 0
        while f"held_{item.kind}_{number}" in used:
            number += 1
        names.append(f"held_{item.kind}_{number}")
        used.add(names[-1])
        same = {
            "type": _HELD[item.kind].geom,
            "pos": item.pose.position,
            "quat": item.pose.quat,
            "size": item.size,
        }
        add_geom(
            body,
            name=names[-1],
            mass=0.0,
            contype=_ALL_BITS,
            conaffinity=_ALL_BITS,
            rgba=[0.35, 0.6, 0.4, 1.0],
            **same,
        )
        weighed.add_geom(mass=(mass or 0.0) * volume / sum(volumes), **same)
    if mass is not None:
        model = alone.compile()
        body.explicitinertial = True
        body.mass, body.ipos = model.body_mass[1], model.body_ipos[1]
        body.iquat, body.inertia = model.body_iquat[1], model.body_inertia[1]
    return names
