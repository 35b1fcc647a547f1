"""The arm in a MuJoCo model of a scene: which bodies and geoms there are its own, and its base."""

import copy
from collections.abc import Hashable

import mujoco
import numpy as np

from gnnjax.arm.mjcf import collision_geoms
from gnnjax.arm.parts import Part, part_of_geom
from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.scene.own_points import distances_to_hull
from gnnjax.scene.pose import Pose, compose, inverse

PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
# What is left out of arms, whichever of their bodies has it.
_GROUND = (PLANE, int(mujoco.mjtGeom.mjGEOM_HFIELD))
_SAME = 1e-6  # m; where a geom of two models is the same
_SAME_PLACE = 1e-3  # m; where a link of two models hangs in the same place
_STANDS_OUT = 0.02  # m; two models of one arm differ by less
_MOST_STEPS = 50  # along the edges of a surface that is looked at


def bodies_of(robot: Robot, model: mujoco.MjModel) -> dict[int, int]:
    """The robot's bodies in a model, by their ids, and which of its own they are; none where the
    robot is not there.

    Names alone do not tell: what stands around may be called like a link, and would be planned
    through. So links hang on each other as in the robot's own model, and one of them at least where
    it does there.
    """
    own, found = robot.mj_model, dict[int, int]()
    numbers = {key: b for b, key in enumerate(_keys(own)) if b}
    for b, key in enumerate(_keys(model)):
        if b and key in numbers:
            above = int(model.body_parentid[b])
            while above and above not in found:
                above = int(model.body_parentid[above])
            if found.get(above, 0) in _above(own, numbers[key]):
                found[b] = numbers[key]
    return found if any(_hangs_alike(own, model, found, b) for b in found) else {}


def _above(own: mujoco.MjModel, b: int) -> list[int]:
    """Where a first body hangs, or one of the links that another one hangs on."""
    above = [int(own.body_parentid[b])]
    while above[-1]:
        above.append(int(own.body_parentid[above[-1]]))
    return above[:-1] or above


def _hangs_alike(own: mujoco.MjModel, model: mujoco.MjModel, found: dict[int, int], b: int) -> bool:
    """Whether a body is a moving link, in its place on the one before it."""
    parent, its = int(own.body_parentid[found[b]]), int(model.body_parentid[b])
    if not own.body_weldid[found[b]]:
        return False
    if not parent:  # the first link of an arm whose base is the world has its joint, somewhere
        return bool(model.body_jntnum[b])
    apart = np.linalg.norm(own.body_pos[found[b]] - model.body_pos[b])
    return found.get(its) == parent and bool(apart < _SAME_PLACE)


def stands_out(robot: Robot, body: int, model: mujoco.MjModel, g: int) -> bool:
    """Whether a geom of a robot's body in a model is none that its own model has there: a table
    that is a part of its base, say, or a tool.

    Args:
        robot: the arm.
        body: of `robot.mj_model`.
        model: which holds the robot.
        g: a geom of that body there.
    """
    if int(model.geom_type[g]) in _GROUND:
        return True
    own = [part for part in robot.parts if part.body == body - 1]
    if not own:
        return True
    part = part_of_geom(model, g, robot.path)
    # The very same, as nearly all are: looking at their surfaces takes up to a second each.
    if any(
        x.vertices.shape == part.vertices.shape
        and np.allclose(x.vertices, part.vertices, rtol=0, atol=_SAME)
        and abs(x.radius - part.radius) <= _SAME
        for x in own
    ):
        return False
    points = _surface(part)
    for x in own:
        points = points[distances_to_hull(x.vertices, points) - x.radius > _STANDS_OUT]
    return len(points) > 0


def _surface(part: Part) -> np.ndarray:
    """Points `[K 3]` all over a part's surface, not much farther apart than `_STANDS_OUT`."""
    from scipy.spatial import ConvexHull  # a fifth of a second

    corners = part.vertices[None]
    if corners.shape[1] > 3:
        corners = part.vertices[ConvexHull(part.vertices).simplices]
    found = []
    for own in corners:
        longest = np.linalg.norm(own - np.roll(own, 1, axis=0), axis=1).max()
        steps = int(np.clip(np.ceil(longest / _STANDS_OUT), 1, _MOST_STEPS))
        shares = np.indices((steps + 1,) * len(own)).reshape(len(own), -1).T
        found.append(shares[shares.sum(axis=1) == steps] / steps @ own)
    points = np.concatenate(found)
    if part.radius:
        around = np.indices((3,) * 3).reshape(3, -1).T - 1.0
        around = around[np.abs(around).sum(axis=1) > 0]
        around *= part.radius / np.linalg.norm(around, axis=1, keepdims=True)
        points = (points[:, None] + around).reshape(-1, 3)
    return points


def _keys(model: mujoco.MjModel) -> list[Hashable]:
    """What bodies of two models are compared by: their names, or else their place among the
    nameless ones of a parent."""
    keys: list[Hashable] = ["world"]
    nameless: dict[Hashable, int] = {}
    for b in range(1, model.nbody):
        name = model.body(b).name
        if not name:
            parent = keys[int(model.body_parentid[b])]
            nameless[parent] = nameless.get(parent, 0) + 1
            # Nothing tells a nameless body of the world from another model's.
            where: Hashable = parent if parent != "world" else object()
            keys.append((where, nameless[parent]))
            continue
        keys.append(name)
    return keys


def base_of(
    robot: Robot,
    bodies: dict[int, int],
    model: mujoco.MjModel,
    data: mujoco.MjData,
    called: str,
) -> Pose:
    """Where the robot's base is in the world of a model that holds it.

    Args:
        robot: the arm.
        bodies: its own, of `bodies_of`.
        model: which holds the robot.
        data: of the model.
        called: how error messages call it.
    """
    own = robot.mj_model
    for there, b in bodies.items():
        if own.body_parentid[b]:
            continue
        if model.body_jntnum[there] and int(model.jnt_type[model.body_jntadr[there]]) != FREE:
            # A first link that its joints move, or that the robot holds in a place of its own.
            data = copy.copy(data)
            _settle(robot, model, data, there)
            mujoco.mj_kinematics(model, data)
        found = Pose(data.xpos[there].copy(), data.xquat[there].copy())
        return compose(found, inverse(Pose(own.body_pos[b], own.body_quat[b])))
    raise InputError(
        f"{called} holds none of the first bodies of {robot.name} "
        f"({[own.body(b).name for b in range(1, min(own.nbody, 4))]}) with its links in their "
        "places; leave robot out where the robot is not in the file, and the world is its base"
    )


def _settle(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData, body: int) -> None:
    """Puts the joints of a body, in place, where the robot holds them, and others at zero."""
    first = int(model.body_jntadr[body])
    for j in range(first, first + int(model.body_jntnum[body])):
        adr, name = int(model.jnt_qposadr[j]), model.joint(j).name
        size = 4 if int(model.jnt_type[j]) == _BALL else 1
        data.qpos[adr : adr + size] = model.qpos0[adr : adr + size]
        if size == 1 and name in robot.held:
            data.qpos[adr] = robot.held[name]


def fixed_geoms(model: mujoco.MjModel) -> list[tuple[int, np.ndarray, Pose]]:
    """Kind, sizes and pose of what a robot's own file has in its world, where no body names it. A
    plane is no part of a robot."""
    return [
        (int(model.geom_type[g]), model.geom_size[g], Pose(model.geom_pos[g], model.geom_quat[g]))
        for g in collision_geoms(model)
        if model.geom_bodyid[g] == 0 and model.geom_type[g] != PLANE
    ]


def is_same(
    model: mujoco.MjModel, g: int, pose: Pose, kind: int, size: np.ndarray, other: Pose
) -> bool:
    """Whether a geom is one of the robot's fixed geoms."""
    return (
        int(model.geom_type[g]) == kind
        and np.allclose(model.geom_size[g], size, atol=_SAME)
        and np.allclose(pose.position, other.position, atol=_SAME)
        and bool(abs(pose.quat @ other.quat) > 1 - _SAME)
    )
