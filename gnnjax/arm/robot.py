"""Robots: joint limits, kinematic constants and collision geometry, read from MJCF.

Everything here is NumPy, computed once when a robot is loaded. The arrays of `Robot` are constants
from which `kinematics.py` and `collision/fused.py` generate their kernels.

Scenes are given in the frame of the arm's base, wherever the MJCF puts that in its world. So the
MJCF is read with its world moved to the base (`mjcf.py`), and from there on, in every kernel, in
MuJoCo's own models and in pictures, "the world" is the base.
"""

import dataclasses
import functools
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.mjcf import (
    check_joints,
    check_numbers,
    joint_name,
    read_spec,
    self_pairs,
    without_warnings,
)
from gnnjax.errors import InputError

# MuJoCo geom types that the fused collision kernel understands.
SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


def assets_dir() -> Path:
    """The folder of the shipped MJCF: inside the wheel, or at the top of a checkout."""
    inside = Path(__file__).parents[1] / "assets"
    return inside if inside.is_dir() else Path(__file__).parents[2] / "assets"


class Joint(NamedTuple):
    """One hinge or slide joint of a body, in the body's frame."""

    index: int  # position in the configuration
    hinge: bool  # false: slide
    axis: np.ndarray  # [3] unit vector
    anchor: np.ndarray  # [3] m, the point the axis goes through


class Body(NamedTuple):
    """One link: how its frame lies in its parent's, and the joints that move it."""

    name: str
    parent: int  # index into `Robot.bodies`, -1 for the world
    position: np.ndarray  # [3] m
    rotation: np.ndarray  # [3 3]
    joints: tuple[Joint, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """A robot arm. Configurations `q` are `[D]`, rad (hinge) or m (slide)."""

    name: str
    path: Path
    mj_model: mujoco.MjModel  # the arm alone, without obstacles
    bodies: tuple[Body, ...]  # parents before children
    joint_lower: np.ndarray  # [D] rad or m
    joint_upper: np.ndarray  # [D] rad or m
    velocity_limit: np.ndarray | None  # [D] rad/s or m/s; None where the MJCF names none
    home: np.ndarray  # [D] the keyframe "home", or the middle of the joint ranges
    geom_ids: np.ndarray  # [G] collision geoms of the MJCF
    geom_bodies: np.ndarray  # [G] index into `bodies`, -1 for geoms fixed to the world
    geom_types: np.ndarray  # [G] MuJoCo geom type
    geom_centers: np.ndarray  # [G 3] m, in the body's frame
    geom_axes: np.ndarray  # [G 3] m, from the centre to one end of a capsule's segment, else 0
    geom_radii: np.ndarray  # [G] m
    self_pairs: np.ndarray  # [S 2] indices of the geoms that must stay clear of each other

    @property
    def num_dof(self) -> int:
        return len(self.joint_lower)

    @property
    def joint_range(self) -> np.ndarray:
        return self.joint_upper - self.joint_lower


@functools.cache
def load_robot(robot: str | Path) -> Robot:
    """Loads a shipped robot by name, or any arm from the path of its MJCF.

    The MJCF needs hinge or slide joints with limits, and geoms with `contype` or `conaffinity` set
    for collision. It may hold `<custom><numeric name="velocity_limit" data="..."/></custom>` and a
    keyframe called `home`.

    Raises:
        InputError: unknown name, broken MJCF, or an MJCF that lacks what planning needs.
    """
    path = Path(robot)
    if path.suffix != ".xml":
        path = assets_dir() / f"{robot}.xml"
        known = sorted(
            file.stem
            for file in assets_dir().glob("*.xml")
            if "<mujoco" in file.read_text(encoding="utf-8")
        )
        if str(robot) not in known:
            raise InputError(
                f"no robot {str(robot)!r} in assets/; there are {known}, "
                "or give the path of an MJCF file ending in .xml"
            )
    elif not path.is_file():
        raise InputError(f"no MJCF file at {str(path)!r}; check the path")
    try:
        with without_warnings():
            model = read_spec(path).compile()
    except ValueError as error:
        raise InputError(f"MuJoCo cannot read {str(path)!r}: {str(error).strip()}") from None
    return _robot_from_model(model, path)


def _robot_from_model(model: mujoco.MjModel, path: Path) -> Robot:
    check_numbers(model, path)
    check_joints(model, path)
    # Only bodies that carry geoms or joints matter, but keeping all makes parents simple:
    # MuJoCo's body 0 is the world, so body b is bodies[b - 1].
    bodies = tuple(_body(model, b) for b in range(1, model.nbody))

    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    collides[model.pair_geom1] = collides[model.pair_geom2] = True
    geom_ids = np.flatnonzero(collides)
    if not len(geom_ids):
        raise InputError(
            f"{str(path)!r} has no collision geometry; give the robot's geoms "
            'contype="1" conaffinity="1" (python -m gnnjax.fit fits spheres to link hulls)'
        )
    axes = np.zeros((len(geom_ids), 3))
    for row, g in enumerate(geom_ids):
        if model.geom_type[g] == CAPSULE:
            axes[row] = _quat_to_matrix(model.geom_quat[g])[:, 2] * model.geom_size[g, 1]

    velocity_limit = None
    numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "velocity_limit")
    if numeric >= 0:
        begin, size = model.numeric_adr[numeric], model.numeric_size[numeric]
        velocity_limit = model.numeric_data[begin : begin + size].astype(np.float32)
        if size != model.njnt or not ((velocity_limit > 0) & np.isfinite(velocity_limit)).all():
            raise InputError(
                f"velocity_limit in {str(path)!r} is {velocity_limit.tolist()}; "
                f"it needs {model.njnt} positive numbers, one a joint"
            )
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    lower, upper = (model.jnt_range[:, side].astype(np.float32) for side in (0, 1))
    home = (model.key_qpos[key] if key >= 0 else model.jnt_range.mean(axis=1)).astype(np.float32)
    outside = ~((home >= lower) & (home <= upper))  # NaN is outside, too
    if outside.any():
        j = int(outside.argmax())
        raise InputError(
            f"keyframe home of {str(path)!r} has {home[j]} for joint {joint_name(model, j)}; it "
            f"must lie between {lower[j]} and {upper[j]}"
        )
    return Robot(
        name=path.stem,
        path=path,
        mj_model=model,
        bodies=bodies,
        joint_lower=lower,
        joint_upper=upper,
        velocity_limit=velocity_limit,
        home=home,
        geom_ids=geom_ids,
        geom_bodies=model.geom_bodyid[geom_ids] - 1,
        geom_types=model.geom_type[geom_ids].copy(),
        geom_centers=model.geom_pos[geom_ids].copy(),
        geom_axes=axes,
        geom_radii=model.geom_size[geom_ids, 0].copy(),
        self_pairs=self_pairs(model, geom_ids, path),
    )


def _body(model: mujoco.MjModel, b: int) -> Body:
    first, count = model.body_jntadr[b], model.body_jntnum[b]
    joints = tuple(
        Joint(
            index=int(j),
            hinge=int(model.jnt_type[j]) == _HINGE,
            axis=model.jnt_axis[j].copy(),
            anchor=model.jnt_pos[j].copy(),
        )
        for j in range(first, first + count)
    )
    return Body(
        name=model.body(b).name,
        parent=int(model.body_parentid[b]) - 1,
        position=model.body_pos[b].copy(),
        rotation=_quat_to_matrix(model.body_quat[b]),
        joints=joints,
    )


def require_round_geoms(robot: Robot) -> None:
    """Refuses an arm that collides as anything but spheres and capsules.

    Raises:
        InputError: names the first geom that is neither.
    """
    for g, kind in zip(robot.geom_ids, robot.geom_types, strict=True):
        if kind not in (SPHERE, CAPSULE):
            name = robot.mj_model.geom(g).name or f"number {g}"
            raise InputError(
                f"collision geom {name} of {robot.name} is neither sphere nor capsule; cover it "
                "with spheres (python -m gnnjax.fit does)"
            )


def _quat_to_matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    # Quaternions such as (0, 0, 1, 1)/sqrt(2) leave 1e-17 where 0 is meant; exact zeros let the
    # kernel generator drop the terms.
    matrix[np.abs(matrix) < 1e-12] = 0.0
    matrix[np.abs(np.abs(matrix) - 1.0) < 1e-12] = np.sign(matrix)[
        np.abs(np.abs(matrix) - 1.0) < 1e-12
    ]
    return matrix.reshape(3, 3)
