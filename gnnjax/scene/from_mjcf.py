"""Obstacles from MuJoCo models: what collides there and is not the robot, as its base sees it."""

import logging
from collections.abc import Callable, Collection
from pathlib import Path

import mujoco
import numpy as np

from gnnjax.arm.mjcf import collision_geoms, soft_bodies, without_warnings
from gnnjax.arm.robot import Robot
from gnnjax.arm.sources import check_meshes
from gnnjax.errors import InputError, brief, is_list, one_line
from gnnjax.scene.cloud import Balls
from gnnjax.scene.pose import IDENTITY, Pose, compose, inverse, moved, moved_points
from gnnjax.scene.robot_in_mjcf import (
    FREE,
    PLANE,
    base_of,
    bodies_of,
    fixed_geoms,
    is_same,
    stands_out,
)
from gnnjax.scene.scene import Scene, scene_from_shapes
from gnnjax.scene.shapes import Shape, box, capsule, cylinder, half_space, sphere
from gnnjax.scene.surfaces import enclosed, height_field

_LOG = logging.getLogger(__name__)
_ORIGIN = np.zeros(3)
# Geoms about their own frame, by their sizes. MuJoCo's planes are solid below, and endless whatever
# their size.
_SHAPES: dict[int, Callable[[np.ndarray], Shape]] = {
    PLANE: lambda size: half_space(_ORIGIN, [0.0, 0.0, 1.0]),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda size: sphere(_ORIGIN, size[0]),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda size: capsule(_ORIGIN, size[0], size[1]),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda size: cylinder(_ORIGIN, size[0], size[1]),
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda size: box(_ORIGIN, size),
}


def _hull(model: mujoco.MjModel, number: int, pose: Pose, called: str) -> Balls:
    """The convex hull of a mesh, which is what MuJoCo collides."""
    from scipy.spatial import ConvexHull  # a fifth of a second, for meshes alone

    first, num = model.mesh_vertadr[number], model.mesh_vertnum[number]
    vertices = moved_points(model.mesh_vert[first : first + num].astype(float), pose)
    return enclosed(vertices, ConvexHull(vertices).simplices, source=called)


def _height_field(model: mujoco.MjModel, number: int, pose: Pose, called: str) -> Balls:
    half_x, half_y, height, below = model.hfield_size[number]
    rows, columns = model.hfield_nrow[number], model.hfield_ncol[number]
    first = model.hfield_adr[number]
    heights = height * model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    depth = below + heights.min()
    return height_field(heights, (2 * half_x, 2 * half_y), *pose, depth=float(depth))


# What is enclosed by balls, by its number among the model's meshes or height fields.
_CLOUDS: dict[int, Callable[[mujoco.MjModel, int, Pose, str], Balls]] = {
    int(mujoco.mjtGeom.mjGEOM_MESH): _hull,
    int(mujoco.mjtGeom.mjGEOM_HFIELD): _height_field,
}


def scene_from_mjcf(
    path: str | Path,
    *,
    robot: Robot | None = None,
    ignore: Collection[str] = (),
    keyframe: str | None = None,
) -> Scene:
    """Reads the obstacles of a MuJoCo model: boxes, spheres, capsules, cylinders, planes, meshes
    and height fields.

    Of a mesh it is the convex hull, as in MuJoCo, and it is enclosed as by `mesh`, like a height
    field.

    Every geom with `contype` or `conaffinity`, or in an explicit pair, is an obstacle, unless it is
    the robot's or ignored. What has neither is for looks alone and no obstacle, as in MuJoCo: a
    warning tells of it, and where nothing else is there it is refused. Bodies stand where the
    model's own pose or a keyframe has them, those with joints, too. The scene is seen from the
    robot's base, or without a robot from the world.

    Args:
        path: of the MJCF.
        robot: the arm that the model holds; its bodies are found by their names and places.
        ignore: names of bodies, with all that hangs on them, of geoms and of flexes.
        keyframe: name of one; by default the model's own pose, `qpos0`.

    Raises:
        InputError: a file that MuJoCo cannot read, a geom of another kind or a flex, a body that
            moves by a hinge or slide joint though no robot is named, or one that the robot carries
            and does not have, or a name that is not there; geoms that all are for looks alone.
    """
    called = f"{str(path)!r}"
    model = _compiled(path, called)
    data = mujoco.MjData(model)
    if keyframe is not None:
        named = isinstance(keyframe, str)
        key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, keyframe) if named else -1
        if key < 0:
            known = [model.key(k).name for k in range(model.nkey)]
            raise InputError(f"no keyframe {keyframe!r} in {called}; there are {known}")
        mujoco.mj_resetDataKeyframe(model, data, key)
    mujoco.mj_kinematics(model, data)
    _check_ignored(model, ignore, called)
    if soft := [name for name in soft_bodies(model) if not _named(name, ignore)]:
        raise InputError(
            f"flex {soft[0]!r} of {called} is soft, which is not read; enclose it in boxes, "
            "spheres, capsules or cylinders, or name it in ignore"
        )
    ignored = _subtrees(model, {b for b in range(1, model.nbody) if model.body(b).name in ignore})
    of_robot, base, fixed = {}, IDENTITY, []
    if robot is not None:
        of_robot = bodies_of(robot, model)
        base = base_of(robot, of_robot, model, data, called)
        fixed = fixed_geoms(robot.mj_model)
    moving = _moving(model)
    carried = _subtrees(model, of_robot.keys() & moving) - of_robot.keys()
    to_base = inverse(base)
    found = []
    for g in collision_geoms(model).tolist():
        body = int(model.geom_bodyid[g])
        if body in ignored or _named(model.geom(g).name, ignore):
            continue
        if robot is not None and body in of_robot:
            if not stands_out(robot, of_robot[body], model, g):
                continue
            if body in moving:
                raise InputError(
                    f"{_name(model, g)} of {called} is no part of {robot.name}, whose own model "
                    "lacks it; load the robot with it, or name it in ignore"
                )
        pose = compose(to_base, _pose_of_geom(data, g))
        if any(is_same(model, g, pose, *other) for other in fixed):
            continue
        inside = f"body {model.body(body).name or body} of {called}"
        if body in carried and robot is not None:
            raise InputError(
                f"{inside} is carried by {robot.name}, whose own model lacks it; load the robot "
                "with it, or name it in ignore"
            )
        if robot is None and body in moving:
            raise InputError(
                f"{inside} moves by a joint; if that is the robot, give robot=load_robot(...) or "
                "name its first body in ignore; if it stands still, remove the joint"
            )
        found.append((g, pose))
    solid = set(collision_geoms(model).tolist())
    _tell_of_looks(
        [
            _name(model, g)
            for g, body in enumerate(model.geom_bodyid.tolist())
            if g not in solid
            and body not in ignored
            and body not in of_robot
            and not _named(model.geom(g).name, ignore)
        ],
        bool(found),
        called,
    )
    # Only now, as meshes may be those of a robot that was not named.
    shapes, clouds = [], []
    for g, pose in found:
        kind = int(model.geom_type[g])
        if kind in _CLOUDS:
            clouds.append(
                _CLOUDS[kind](
                    model, int(model.geom_dataid[g]), pose, f"{_name(model, g)} of {called}"
                )
            )
        else:
            shapes.append(moved(_shape(model, g, called), pose))
    return scene_from_shapes(shapes, clouds=clouds, source=called)


def _tell_of_looks(geoms: list[str], anything: bool, called: str) -> None:
    """Says that what does not collide is no obstacle; refuses it where there is nothing else, as
    planners would go through all of the scene."""
    if not geoms:
        return
    said = (
        f"geoms of {called} that are for looks alone (contype and conaffinity 0) are no obstacles: "
        f"{len(geoms)}, the first is {geoms[0]}"
    )
    if not anything:
        raise InputError(f"{said}; nothing else is there, so let what is solid collide (contype)")
    _LOG.warning("%s", one_line(said))


def mjcf_holds(path: str | Path, robot: Robot) -> bool:
    """Whether a MuJoCo model holds a robot.

    Raises:
        InputError: a file that MuJoCo cannot read.
    """
    return bool(bodies_of(robot, _compiled(path, f"{str(path)!r}")))


def _compiled(path: str | Path, called: str) -> mujoco.MjModel:
    if not Path(path).is_file():
        raise InputError(f"no MJCF file at {called}; check the path")
    check_meshes(Path(path))
    try:
        with without_warnings():
            spec = mujoco.MjSpec.from_file(str(path))
            spec.compiler.discardvisual = False  # what is no obstacle is told of
            spec.compiler.fusestatic = False  # bodies keep their names, as those of robots do
            return spec.compile()
    except ValueError as error:
        raise InputError(f"MuJoCo cannot read {called}: {str(error).strip()}") from None


def _named(name: str, ignore: Collection[str]) -> bool:
    return bool(name) and name in ignore


def _check_ignored(model: mujoco.MjModel, ignore: Collection[str], called: str) -> None:
    if not is_list(ignore):
        raise InputError(f"ignore is {brief(ignore)}; give a list of names")
    bodies = [model.body(b).name for b in range(1, model.nbody)]
    geoms = [model.geom(g).name for g in range(model.ngeom)]
    for name in ignore:
        if not _named(name, {*bodies, *geoms, *soft_bodies(model)}):
            known = [x for x in bodies if x], [x for x in geoms if x]
            raise InputError(
                f"no body or geom {name!r} to ignore in {called}; its bodies are {known[0]}, its "
                f"geoms {known[1]}"
            )


def _subtrees(model: mujoco.MjModel, roots: set[int]) -> set[int]:
    """Bodies with all that hang on them; parents come first in a model."""
    found = set(roots)
    for b in range(1, model.nbody):
        if int(model.body_parentid[b]) in found:
            found.add(b)
    return found


def _moving(model: mujoco.MjModel) -> set[int]:
    """Bodies that a hinge, slide or ball joint moves; free ones lie where they are put."""
    jointed = {
        int(body)
        for body, kind in zip(model.jnt_bodyid, model.jnt_type, strict=True)
        if int(kind) != FREE
    }
    return _subtrees(model, jointed)


def _pose_of_geom(data: mujoco.MjData, g: int) -> Pose:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, data.geom_xmat[g])
    return Pose(data.geom_xpos[g].copy(), quat)


def _name(model: mujoco.MjModel, g: int) -> str:
    body = int(model.geom_bodyid[g])
    return f"geom {model.geom(g).name or g} (of body {model.body(body).name or body})"


def _shape(model: mujoco.MjModel, g: int, called: str) -> Shape:
    kind = int(model.geom_type[g])
    if kind not in _SHAPES:
        word = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
        raise InputError(
            f"{_name(model, g)} of {called} is of the type {word}, which is not read; enclose it "
            "in boxes, spheres, capsules or cylinders, or name it in ignore"
        )
    return _SHAPES[kind](model.geom_size[g])
