"""The arm and its obstacles as one MuJoCo model, for the C engine and pictures."""

import functools
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.mjcf import HIDING, add_geom
from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.scene.allowed import refuse_allowed
from gnnjax.scene.cloud import Cloud
from gnnjax.scene.own_points import distances_to_hull
from gnnjax.scene.scene import Scene, obstacle_name
from gnnjax.scene.shapes import KINDS, for_every_kind, known_kinds

# Where obstacles that do not exist are put: far enough to be clear, near enough for float32.
FAR_AWAY = 1e3

# MuJoCo geoms of obstacles.
_GEOMS = for_every_kind(
    "MuJoCo world",
    box=mujoco.mjtGeom.mjGEOM_BOX,
    sphere=mujoco.mjtGeom.mjGEOM_SPHERE,
    capsule=mujoco.mjtGeom.mjGEOM_CAPSULE,
    cylinder=mujoco.mjtGeom.mjGEOM_CYLINDER,
    half_space=mujoco.mjtGeom.mjGEOM_BOX,
)
# All bits of MuJoCo's contype and conaffinity.
_ALL_BITS = -1


_NEAR = 0.05  # m; no test takes what is farther apart for a contact


class Obstacles(NamedTuple):
    """Where a world has its movable obstacles; they come last in it."""

    bodies: np.ndarray  # [M] body ids
    geoms: np.ndarray  # [M] geom ids
    mocaps: np.ndarray  # [M] rows of `mocap_pos`


_CLOUD = "cloud of points"  # the body that holds it
_OBSTACLE = {"contype": _ALL_BITS, "conaffinity": _ALL_BITS, "rgba": [0.75, 0.55, 0.35, 1.0]}


def build_world(robot: Robot, max_obstacles: int, cloud: Cloud | None = None) -> mujoco.MjModel:
    """Compiles the world of `world_spec`."""
    return world_spec(robot, max_obstacles, cloud).compile()


def world_spec(robot: Robot, max_obstacles: int, cloud: Cloud | None = None) -> mujoco.MjSpec:
    """The arm with `max_obstacles` movable obstacles, which `obstacles` finds.

    Each is a mocap body of its own. A geom that sits in the worldbody and is moved after
    compilation would keep the bounding volume of its old place, and the C engine would miss it.

    Args:
        robot: the arm.
        max_obstacles: M.
        cloud: of the scene; a sphere for each of its points, none of which can be moved.
    """
    spec = robot.mj_spec.copy()
    spec.option.disableflags &= ~HIDING
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)  # margins of their own
    spec.memory = -1  # as much as the contacts need, whatever the MJCF says
    prefix = "box_"
    while any(x.name.startswith(prefix) for x in (*spec.bodies, *spec.geoms)):
        prefix = f"_{prefix}"
    ignored = _static_bodies(spec, prefix)
    paired = _paired_alone(robot)
    if cloud is not None:
        _add_cloud(spec, cloud, ignored, paired)
    for i in range(max_obstacles):
        body = spec.worldbody.add_body(name=f"{prefix}{i}", mocap=True, pos=[FAR_AWAY, 0, i])
        # All bits: an obstacle meets whatever collision group a robot's author chose.
        add_geom(
            body,
            name=f"{prefix}{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,  # until an obstacle takes its place
            size=[0.1, 0.1, 0.1],
            **_OBSTACLE,
        )
        # MuJoCo pairs a mocap body with static bodies; that says nothing about a configuration.
        for name in ignored:
            spec.add_exclude(bodyname1=name, bodyname2=body.name)
        ignored.append(body.name)
        for name in paired:
            spec.add_pair(geomname1=name, geomname2=body.name)
    return spec


def _add_cloud(spec: mujoco.MjSpec, cloud: Cloud, ignored: list[str], paired: list[str]) -> None:
    # Mocap, since what is welded to the world does not meet what else is.
    body = spec.worldbody.add_body(name=_CLOUD, mocap=True)
    radius = float(cloud.radius)
    for i, point in enumerate(np.asarray(cloud.points[: int(cloud.num)], float)):
        geom = add_geom(
            body,
            name=f"{_CLOUD} {i}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=point,
            size=[radius, 0, 0],
            **_OBSTACLE,
        )
        for name in paired:
            spec.add_pair(geomname1=name, geomname2=geom.name)
    for name in ignored:
        spec.add_exclude(bodyname1=name, bodyname2=_CLOUD)
    ignored.append(_CLOUD)


def obstacles(model: mujoco.MjModel, max_obstacles: int) -> Obstacles:
    """The obstacles of a world from `build_world`, in the order of a scene's."""
    last = np.arange(-max_obstacles, 0)
    return Obstacles(model.nbody + last, model.ngeom + last, model.nmocap + last)


def _static_bodies(spec: mujoco.MjSpec, prefix: str) -> list[str]:
    """Names of the world and the bodies welded to it; bodies without a name get one."""
    names, bodies = [], [spec.worldbody]
    while bodies:
        body = bodies.pop()
        if not body.name:
            body.name = f"{prefix}static_{len(names)}"
        names.append(body.name)
        bodies += [child for child in body.bodies if not child.joints]
    return names


def _paired_alone(robot: Robot) -> list[str]:
    """Names of the moving geoms that collide by the MJCF's explicit pairs alone, not by bits."""
    model = robot.mj_model
    return [
        model.geom(g).name  # they have names, or no pair could name them
        for g in robot.part_geoms.tolist()
        if not (model.geom_contype[g] or model.geom_conaffinity[g])
        and model.body_weldid[model.geom_bodyid[g]]
    ]


def place_obstacles(model: mujoco.MjModel, data: mujoco.MjData, scene: Scene) -> None:
    """Gives the obstacles of a world a scene's kinds, places and sizes, in place.

    Raises:
        InputError: a scene with a cloud, in a world that was built for another; one in which
            contacts are meant; or an obstacle that is of no kind.
    """
    refuse_allowed(scene, "a MuJoCo world")
    mask = np.asarray(scene.mask)
    held = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, _CLOUD)
    spheres = int(model.body_geomnum[held]) if held >= 0 else 0
    points = 0 if scene.cloud is None else int(scene.cloud.num)
    if spheres != points:
        raise InputError(
            f"the scene has a cloud of {points} points, and the MuJoCo world one of {spheres}; "
            "build the world with the scene's cloud"
        )
    kinds = known_kinds(scene.half_extents, scene.radii, mask)
    for i, (body, geom, mocap) in enumerate(zip(*obstacles(model, len(mask)), strict=True)):
        exists = bool(mask[i])
        data.mocap_pos[mocap] = np.asarray(scene.centers[i]) if exists else [FAR_AWAY, 0, i]
        data.mocap_quat[mocap] = np.asarray(scene.quats[i]) if exists else [1, 0, 0, 0]
        if exists:
            extents = np.asarray(scene.half_extents[i], dtype=float)
            disc, ball = np.asarray(scene.radii[i], dtype=float)
            model.geom_type[geom] = _GEOMS[KINDS[kinds[i]]]
            # MuJoCo wants the radius first, then the half length.
            is_round = disc + ball > 0
            model.geom_size[geom] = [disc + ball, extents[2], 0] if is_round else extents
            around = extents + np.array([disc + ball, disc + ball, ball])
            model.geom_rbound[geom] = np.linalg.norm(around)
            model.geom_aabb[geom, 3:] = around
            node = model.body_bvhadr[body]
            model.bvh_aabb[node, 3:] = around


class Contact(NamedTuple):
    """Two things that overlap, as messages call them."""

    first: str
    second: str
    depth: float  # m


def deepest_contact(
    robot: Robot, scene: Scene, q: np.ndarray, within: float = 0.0
) -> Contact | None:
    """What is in collision at a configuration `[D]` of one scene: by the C engine, or, with its
    cloud, by the distances of points to the arm's parts.

    Args:
        robot: the arm.
        scene: one scene.
        q: configuration.
        within: what is apart by less, m, is told too, and has a negative depth.
    """
    model = _cached_world(robot, len(scene.mask))
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene._replace(cloud=None, allowed=None))
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    parts, names = robot.part_geoms.tolist(), [part.name for part in robot.parts]
    found = [
        (depth_of(model, data, parts[a], parts[b], within), names[a], names[b])
        for a, b in robot.part_pairs.tolist()
    ]
    placed = obstacles(model, len(scene.mask)).geoms
    moving = [number for number, g in enumerate(parts) if _is_moved(model, g)]
    for i in np.flatnonzero(scene.mask).tolist():
        found += [
            (depth_of(model, data, parts[number], int(placed[i]), within), names[number], i)
            for number in moving
            if not _is_meant(scene, i, robot.parts[number].body)
        ]
    depth, part = _depth_in_cloud(robot, scene, model, data, moved=True, within=within)
    if depth > -within:
        found.append((depth, part, "the cloud"))
    depth, first, second = max(found, key=lambda one: one[0], default=(-within, "", ""))
    if depth <= -within:
        return None
    return Contact(
        first, obstacle_name(scene, second) if isinstance(second, int) else second, depth
    )


def nearest_things(robot: Robot, scene: Scene, q: np.ndarray) -> str | None:
    """What is nearest to each other at a configuration `[D]` of one scene that is free by less than
    tests can tell, for a message; None where nothing is near."""
    near = deepest_contact(robot, scene, q, within=_NEAR)
    return near and (
        f"{near.first} and {near.second} are {1e3 * max(0.0, -near.depth):.2g} mm apart, too "
        "little for a contact to be ruled out"
    )


def depth_in_base(robot: Robot, scene: Scene, i: int) -> float:
    """How far an obstacle of one scene reaches into what no joint moves of the arm, m; 0 or less
    where it does not. Of the cloud, which comes after the last: its points, as its balls stand out
    of what was seen."""
    model = _cached_world(robot, len(scene.mask))
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene._replace(cloud=None, allowed=None))
    mujoco.mj_kinematics(model, data)
    if i == len(scene.mask) and scene.cloud is not None:
        cloud = scene.cloud._replace(radius=np.float32(0))
        return _depth_in_cloud(robot, scene._replace(cloud=cloud), model, data, moved=False)[0]
    obstacle = int(obstacles(model, len(scene.mask)).geoms[i])
    fixed = [
        g
        for g, part in zip(robot.part_geoms.tolist(), robot.parts, strict=True)
        if not (_is_moved(model, g) or _is_meant(scene, i, part.body))
    ]
    return max((depth_of(model, data, g, obstacle) for g in fixed), default=0.0)


def _depth_in_cloud(
    robot: Robot,
    scene: Scene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    *,
    moved: bool,
    within: float = 0.0,
) -> tuple[float, str]:
    """How far a cloud reaches into the parts that joints move, or that none moves, m; and into
    which part. Gaps below `within` are negative depths."""
    deepest = -within, ""
    if scene.cloud is None or not int(scene.cloud.num):
        return deepest
    points, ball = np.asarray(scene.cloud.points[: int(scene.cloud.num)], float), scene.cloud.radius
    for g, part in zip(robot.part_geoms.tolist(), robot.parts, strict=True):
        body, reach = int(model.geom_bodyid[g]), part.radius + float(ball)
        if _is_moved(model, g) != moved:
            continue
        seen = (points - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
        far = reach + within
        low, high = part.vertices.min(axis=0) - far, part.vertices.max(axis=0) + far
        near = seen[((seen > low) & (seen < high)).all(axis=1)]
        if len(near):
            depth = reach - float(distances_to_hull(part.vertices, near).min())
            deepest = max(deepest, (depth, part.name))
    return deepest


def _is_meant(scene: Scene, i: int, body: int) -> bool:
    """Whether a body may touch obstacle i; the world, which is -1, may touch none."""
    return scene.allowed is not None and body >= 0 and bool(scene.allowed.pairs[i, body])


def _is_moved(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.body_weldid[model.geom_bodyid[geom]])


def depth_of(
    model: mujoco.MjModel, data: mujoco.MjData, first: int, second: int, within: float = 0.0
) -> float:
    """How far two geoms overlap, m; 0 or less where they do not, and by how much they are apart
    where that is less than `within`."""
    return -mujoco.mj_geomDistance(model, data, first, second, within + 1e-3, None)


@functools.lru_cache(maxsize=8)
def _cached_world(robot: Robot, max_obstacles: int) -> mujoco.MjModel:
    return build_world(robot, max_obstacles)
