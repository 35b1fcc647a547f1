"""MoveIt's planning scenes, written as YAML: the obstacles around an arm, as its base sees them.

What stands in such a scene and is not read would be planned through, so that all of it is read or
refused. The allowed collision matrix alone is left out: where it lets the arm touch an obstacle,
the arm stays clear of it here.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gnnjax.errors import InputError, brief
from gnnjax.scene.cloud import Balls
from gnnjax.scene.messages import components, fields_of, list_of, numbers, pose_of, read_message
from gnnjax.scene.octomap import voxels
from gnnjax.scene.pose import IDENTITY, Pose, compose, inverse, moved, moved_points
from gnnjax.scene.scene import Scene, scene_from_shapes
from gnnjax.scene.shapes import Shape, box, cylinder, half_space, sphere
from gnnjax.scene.surfaces import enclosed

_SCENE = (
    "name is_diff robot_state robot_model_name fixed_frame_transforms allowed_collision_matrix "
    "link_padding link_scale object_colors world"
).split()
_OBJECT = (
    "header id type pose primitives primitive_poses meshes mesh_poses planes plane_poses "
    "subframe_names subframe_poses operation"
).split()
_STATE = "joint_state multi_dof_joint_state attached_collision_objects is_diff".split()
_MULTI_DOF = "header joint_names transforms twist wrench".split()
_TRANSFORM = ("translation", "rotation")

# Numbers of shape_msgs/SolidPrimitive.
_PRIMITIVES = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone", 5: "prism"}
# How many dimensions each that is read has, and what they are.
_DIMENSIONS = {"box": (3, "x, y, z"), "sphere": (1, "radius"), "cylinder": (2, "height, radius")}
_ADD = (None, 0, b"\0", "add", "ADD")  # `operation`, as the writers of such files put it


class Surface(NamedTuple):
    """A shape_msgs/Mesh."""

    vertices: np.ndarray  # [V 3] m
    faces: np.ndarray  # [F 3]
    source: str  # how error messages call it


class PlanningScene(NamedTuple):
    """What a file holds, in the planning frame."""

    shapes: list[Shape]
    surfaces: list[Surface]
    voxels: list[Balls]  # of its octomap
    base: Pose | None  # of the robot's root link there; None where the file does not say


def scene_from_moveit(path: str | Path) -> Scene:
    """Reads a planning scene of MoveIt (moveit_msgs/PlanningScene) from YAML.

    Boxes, spheres, cylinders, planes and meshes of the collision objects are read, and the octomap;
    of a plane, all that lies beyond it from the base is taken, and meshes and occupied voxels are
    enclosed as by `mesh` and `octomap`. Objects are in
    the planning frame, or in a frame that `fixed_frame_transforms` names. Where the robot state
    places the robot by a joint of several degrees of freedom, its root link is the base that the
    scene is seen from; else the planning frame is.

    Raises:
        InputError: the file is missing or no YAML; it holds cones, or objects that are
            attached to the robot; or something in it is not as the message demands.
    """
    return scene_of(read_planning_scene(path), f"planning scene {str(path)!r}")


def scene_of(found: PlanningScene, called: str) -> Scene:
    """A planning scene as the base of its robot sees it."""
    to_base = inverse(found.base or IDENTITY)
    shapes = [_beyond(moved(shape, to_base)) for shape in found.shapes]
    clouds = [
        enclosed(moved_points(vertices, to_base), faces, source=source)
        for vertices, faces, source in found.surfaces
    ]
    clouds += [x._replace(points=moved_points(x.points, to_base)) for x in found.voxels]
    return scene_from_shapes(shapes, clouds=clouds, source=called)


def _beyond(shape: Shape) -> Shape:
    """MoveIt's planes have no inside, but an arm gets through none: it is on its base's side."""
    if shape.kind != "half_space":
        return shape
    point, normal = (np.asarray(shape.values[name], float) for name in ("point", "normal"))
    return half_space(point, -normal) if point @ normal > 1e-9 else shape


def read_planning_scene(path: str | Path) -> PlanningScene:
    """Reads what `scene_from_moveit` does, before the base sees it."""
    called = f"planning scene {str(path)!r}"
    message = read_message(path, "planning scene", _SCENE)
    if message.get("is_diff"):
        raise InputError(f"{called} is a difference to another; give a whole one")
    for name, entry, usual in (("link_padding", "padding", 0), ("link_scale", "scale", 1)):
        for value in list_of(message, name, called):
            fields = fields_of(value, ("link_name", entry), f"{name} of {called}")
            if fields.get(entry) != usual:
                raise InputError(
                    f"{called} has {name} {brief(fields.get(entry))} for a link of the robot; "
                    f"robots are as their files have them, so set it to {usual}"
                )
    if message.get("world") is None:
        raise InputError(f"{called} has no world; give what stands there, or collision_objects: []")
    world = fields_of(message.get("world"), ("collision_objects", "octomap"), f"world of {called}")
    objects = list_of(world, "collision_objects", called)
    frames = _frames(message, [*objects, world.get("octomap")], called)
    state = message.get("robot_state")
    things = [thing for value in objects for thing in _object(value, frames, called)]
    shapes = [thing for thing in things if isinstance(thing, Shape)]
    surfaces = [thing for thing in things if isinstance(thing, Surface)]
    found = _voxels(world.get("octomap"), frames, f"octomap of {called}")
    return PlanningScene(shapes, surfaces, found, base_of(state, frames, called))


def _voxels(value: Any, frames: dict[str, Pose], called: str) -> list[Balls]:
    """What is occupied in an octomap (octomap_msgs/OctomapWithPose), in the planning frame."""
    outer = fields_of(value, ("header", "origin", "octomap"), called)
    known = "header binary id resolution data".split()
    fields = fields_of(outer.get("octomap"), known, called)
    if not fields.get("data"):
        return []
    given = fields["data"]
    if not isinstance(given, bytes):
        whole = numbers(given, None, f"data of {called}")
        # Of bytes, some writers see the sign and others do not.
        if not np.isin(whole, np.arange(-128, 256)).all():
            raise InputError(f"data of {called} = {brief(given)}; give bytes, -128 to 255")
        given = whole.astype(np.int16).astype(np.uint8).tobytes()
    binary = fields.get("binary")
    if not isinstance(binary, bool):
        raise InputError(f"{called} has binary = {brief(binary)}; give true or false")
    balls = voxels(given, binary, str(fields.get("id")), fields.get("resolution"), called)
    pose = _placed_in(outer, frames, called)
    if outer.get("origin") is not None:
        origin = pose_of(outer["origin"], f"origin of {called}", may_be_unset=True)
        pose = compose(pose, origin)
    found = balls._replace(points=moved_points(balls.points, pose))
    return [found] if len(found.points) else []


def _frames(message: dict, objects: list, called: str) -> dict[str, Pose]:
    """Poses, in the planning frame, of the frames that objects may be in."""
    frames, planning = {"": IDENTITY}, set()
    for value in list_of(message, "fixed_frame_transforms", called):
        inside = f"a transform of fixed_frame_transforms of {called}"
        fields = fields_of(value, ("header", "child_frame_id", "transform"), inside)
        planning.add(frame_id(fields, inside))
        name = str(fields.get("child_frame_id", ""))
        frames[name] = pose_of(fields.get("transform"), inside, _TRANSFORM)
    planning.discard("")
    if len(planning) > 1:
        raise InputError(
            f"fixed_frame_transforms of {called} are given in the frames {sorted(planning)}; give "
            "all in the planning frame"
        )
    for name in planning:
        frames.setdefault(name, IDENTITY)
    if len(frames) == 1:
        # Nothing says what the planning frame is called, and there is no other to be in.
        named = {frame_id(x, called) for x in objects if isinstance(x, dict)} - {""}
        if len(named) == 1:
            frames[named.pop()] = IDENTITY
    return frames


def frame_id(message: dict, called: str) -> str:
    """The frame that a message's header names."""
    known = ("frame_id", "stamp", "seq")
    header = fields_of(message.get("header"), known, f"header of {called}")
    return str(header.get("frame_id") or "").lstrip("/")


def _placed_in(message: dict, frames: dict[str, Pose], called: str) -> Pose:
    name = frame_id(message, called)
    if name not in frames:
        raise InputError(
            f"{called} is in the frame {name!r}, and there are {sorted(frames)}; add it to "
            "fixed_frame_transforms"
        )
    return frames[name]


def base_of(state: Any, frames: dict[str, Pose], called: str) -> Pose | None:
    """Where a robot state (moveit_msgs/RobotState) has the robot's root link.

    Raises:
        InputError: objects are attached to the robot, or more than one joint could place it.
    """
    fields = fields_of(state, _STATE, f"robot state of {called}")
    if fields.get("attached_collision_objects"):
        raise InputError(
            f"{called} has objects attached to the robot, which are not read; make them a part of "
            "the robot's model, and remove them"
        )
    inside = f"multi_dof_joint_state of {called}"
    joints = fields_of(fields.get("multi_dof_joint_state"), _MULTI_DOF, inside)
    transforms = list_of(joints, "transforms", inside)
    names = list_of(joints, "joint_names", inside)
    if len(transforms) != len(names) or len(names) > 1:
        raise InputError(
            f"{inside} has {len(transforms)} transforms for the joints {brief(names)}; give one, "
            "of the joint that places the robot"
        )
    if not names:
        return None
    outer = _placed_in(joints, frames, inside)
    return compose(outer, pose_of(transforms[0], inside, _TRANSFORM))


def _object(value: Any, frames: dict[str, Pose], called: str) -> list[Shape | Surface]:
    """The obstacles of a collision object, in the planning frame."""
    fields = fields_of(value, _OBJECT, f"a collision object of {called}")
    inside = f"object {brief(fields.get('id', ''))} of {called}"
    if fields.get("operation") not in _ADD:
        raise InputError(
            f"{inside} has the operation {brief(fields['operation'])}; a scene has objects to add "
            "alone, so give it as it is in the end"
        )
    outer = _placed_in(fields, frames, inside)
    placed = fields.get("pose") is not None
    if placed:
        pose = pose_of(fields["pose"], f"pose of {inside}", may_be_unset=True)
        outer = compose(outer, pose)
    things = []
    kinds = ("primitive", "primitives", _primitive), ("plane", "planes", _plane)
    for kind, plural, read in (*kinds, ("mesh", "meshes", _mesh)):
        listed = list_of(fields, plural, inside)
        poses = list_of(fields, f"{kind}_poses", inside)
        if placed and not poses:  # the object's is theirs, as MoveIt has it
            local = [IDENTITY] * len(listed)
        elif len(poses) == len(listed):
            local = [pose_of(x, f"{kind} {i} of {inside}") for i, x in enumerate(poses)]
        else:
            raise InputError(
                f"{inside} has {len(poses)} {kind}_poses for {len(listed)} {plural}; give each one"
            )
        for i, (one, pose) in enumerate(zip(listed, local, strict=True)):
            thing, pose = read(one, f"{kind} {i} of {inside}"), compose(outer, pose)
            if isinstance(thing, Surface):
                things.append(thing._replace(vertices=moved_points(thing.vertices, pose)))
            else:
                things.append(moved(thing, pose))
    if not things:
        raise InputError(
            f"{inside} has no primitives, planes or meshes; give it some, or remove it"
        )
    return things


def _primitive(value: Any, called: str) -> Shape:
    """A shape_msgs/SolidPrimitive about its own centre."""
    fields = fields_of(value, ("type", "dimensions", "polygon"), called)
    given = fields.get("type")
    kind = _PRIMITIVES.get(given) if type(given) is int else str(given).lower()
    if kind not in _DIMENSIONS:
        remedy = ": enclose it in one of them" if kind in _PRIMITIVES.values() else ""
        raise InputError(
            f"{called} has the type {brief(kind or given)}; there are {list(_DIMENSIONS)}{remedy}"
        )
    width, meaning = _DIMENSIONS[kind]
    sizes = numbers(fields.get("dimensions"), width, f"dimensions ({meaning}) of {called}")
    if not (sizes > 0).all():
        raise InputError(
            f"dimensions ({meaning}) of {called} are {sizes.tolist()}; they must be positive (m)"
        )
    if kind == "box":
        return box(np.zeros(3), sizes / 2)
    if kind == "sphere":
        return sphere(np.zeros(3), sizes[0])
    return cylinder(np.zeros(3), radius=sizes[1], half_length=sizes[0] / 2)


def _mesh(value: Any, called: str) -> Surface:
    """A shape_msgs/Mesh."""
    fields = fields_of(value, ("triangles", "vertices"), called)
    points = list_of(fields, "vertices", called)
    vertices = [components(x, "xyz", f"vertex {i} of {called}") for i, x in enumerate(points)]
    faces = []
    for i, triangle in enumerate(list_of(fields, "triangles", called)):
        inside = f"triangle {i} of {called}"
        given = fields_of(triangle, ("vertex_indices",), inside).get("vertex_indices")
        corners = numbers(given, 3, f"vertex_indices of {inside}")
        if not all(x in range(len(vertices)) for x in corners):
            raise InputError(
                f"vertex_indices of {inside} are {brief(given)}; there are {len(vertices)} vertices"
            )
        faces.append(corners.astype(int))
    return Surface(np.reshape(vertices, (-1, 3)), np.reshape(faces, (-1, 3)).astype(int), called)


def _plane(value: Any, called: str) -> Shape:
    """A shape_msgs/Plane a x + b y + c z + d = 0."""
    fields = fields_of(value, ("coef",), called)
    *normal, offset = numbers(fields.get("coef"), 4, f"coef of {called}")
    length = float(np.linalg.norm(normal))
    if not length > 1e-6:
        raise InputError(f"coef of {called} has the normal {normal}; give a direction, not zeros")
    normal = np.array(normal) / length
    return half_space(-offset / length * normal, normal)
