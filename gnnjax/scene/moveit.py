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
from gnnjax.scene.collision_objects import Surface, frame_id, placed_in, shapes_of_object
from gnnjax.scene.messages import fields_of, list_of, numbers, pose_of, read_message
from gnnjax.scene.octomap import voxels
from gnnjax.scene.pose import IDENTITY, Pose, compose, inverse, moved, moved_points
from gnnjax.scene.scene import Scene, scene_from_shapes
from gnnjax.scene.shapes import Shape, half_space
from gnnjax.scene.surfaces import enclosed

_SCENE = (
    "name is_diff robot_state robot_model_name fixed_frame_transforms allowed_collision_matrix "
    "link_padding link_scale object_colors world"
).split()
_STATE = "joint_state multi_dof_joint_state attached_collision_objects is_diff".split()
JOINT_STATE = "header name position velocity effort".split()
_ATTACHED = "link_name object touch_links detach_posture weight".split()
_MULTI_DOF = "header joint_names transforms twist wrench".split()
_TRANSFORM = ("translation", "rotation")
_THROUGH_BASE = 1e-6  # m; files give poses in no more digits


class Attached(NamedTuple):
    """A moveit_msgs/AttachedCollisionObject."""

    link: str
    shapes: list[Shape]  # in the link's frame
    touches: list[str]  # links that it may touch
    mass: float | None  # kg; None where the message does not say
    source: str  # how error messages call it


class RobotState(NamedTuple):
    """What a moveit_msgs/RobotState says beside where joints are."""

    base: Pose | None  # of the robot's root link, in the planning frame; None where it is not said
    attached: list[Attached]
    joints: list[str]  # of which it says where they are


class PlanningScene(NamedTuple):
    """What a file holds, in the planning frame."""

    shapes: list[Shape]
    surfaces: list[Surface]
    voxels: list[Balls]  # of its octomap
    state: RobotState


def scene_from_moveit(path: str | Path) -> Scene:
    """Reads a planning scene of MoveIt (moveit_msgs/PlanningScene) from YAML.

    Boxes, spheres, cylinders, planes and meshes of the collision objects are read, and the octomap;
    of a plane, all that lies beyond it from the base is taken, or below it where it goes through
    the base, and meshes and occupied voxels are enclosed as by `mesh` and `octomap`. Objects are in
    the planning frame, or in a frame that `fixed_frame_transforms` names. Where the robot state
    places the robot by a joint of several degrees of freedom, its root link is the base that the
    scene is seen from; else the planning frame is.

    Raises:
        InputError: the file is missing or no YAML; it holds cones, or objects that are attached to
            the robot, for which there is `query_from_moveit`; or something in it is not as the
            message demands.
    """
    found, called = read_planning_scene(path), f"planning scene {str(path)!r}"
    refuse_attached(found.state, called)
    return scene_of(found, called)


def refuse_attached(state: RobotState, called: str) -> None:
    """Refuses objects that are attached to the robot, for who gives no robot."""
    if state.attached:
        raise InputError(
            f"{called} has objects attached to the robot; query_from_moveit gives the arm that "
            "holds them, or remove them"
        )


def scene_of(found: PlanningScene, called: str) -> Scene:
    """The obstacles of a planning scene as the base of its robot sees them."""
    to_base = inverse(found.state.base or IDENTITY)
    shapes = [_beyond(moved(shape, to_base)) for shape in found.shapes]
    clouds = [
        enclosed(moved_points(vertices, to_base), faces, source=source)
        for vertices, faces, source in found.surfaces
    ]
    clouds += [x._replace(points=moved_points(x.points, to_base)) for x in found.voxels]
    return scene_from_shapes(shapes, clouds=clouds, source=called)


def _beyond(shape: Shape) -> Shape:
    """MoveIt's planes have no inside, but an arm gets through none: it is on its base's side. Of
    one through the base, it is on the upper side."""
    if shape.kind != "half_space":
        return shape
    point, normal = (np.asarray(shape.values[name], float) for name in ("point", "normal"))
    above = point @ normal  # of the plane over the base, as the normal sees it
    flipped = normal[2] < 0 if abs(above) < _THROUGH_BASE else above > 0
    return half_space(point, -normal) if flipped else shape


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
    things = [thing for value in objects for thing in shapes_of_object(value, frames, called)]
    shapes = [thing for thing in things if isinstance(thing, Shape)]
    surfaces = [thing for thing in things if isinstance(thing, Surface)]
    found = _voxels(world.get("octomap"), frames, f"octomap of {called}")
    return PlanningScene(shapes, surfaces, found, state_of(state, frames, called))


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
    pose = placed_in(outer, frames, called)
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
        name = str(fields.get("child_frame_id") or "").lstrip("/")
        if not name:
            raise InputError(f"{inside} has no child_frame_id; name the frame that it is of")
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


def state_of(state: Any, frames: dict[str, Pose], called: str) -> RobotState:
    """Where a robot state (moveit_msgs/RobotState) has the robot's root link, and what it holds.

    Raises:
        InputError: more than one joint could place the robot, or it holds what no arm can here.
    """
    fields = fields_of(state, _STATE, f"robot state of {called}")
    attached = list_of(fields, "attached_collision_objects", called)
    joints = fields_of(fields.get("joint_state"), JOINT_STATE, f"joint_state of {called}")
    names = [str(x) for x in list_of(joints, "name", called)]
    return RobotState(
        _base(fields, frames, called), [_attached(x, called) for x in attached], names
    )


def _attached(value: Any, called: str) -> Attached:
    fields = fields_of(value, _ATTACHED, f"an attached object of {called}")
    link, thing = str(fields.get("link_name") or ""), fields.get("object")
    inside = f"object attached to {brief(link)} in {called}"
    frame = frame_id(thing, inside) if isinstance(thing, dict) else link
    if not link or frame != link:
        raise InputError(
            f"{inside} is in the frame {brief(frame)}; give it in that of its link, as MoveIt does"
        )
    things = shapes_of_object(thing, {link: IDENTITY}, inside)
    shapes = [x for x in things if isinstance(x, Shape) and x.kind != "half_space"]
    if len(shapes) < len(things):
        raise InputError(
            f"{inside} has a mesh or a plane, which no arm can hold here; enclose it in a box or "
            "cylinder"
        )
    (mass,) = numbers([fields.get("weight") or 0], 1, f"weight of {inside}")
    if mass < 0:
        raise InputError(f"weight of {inside} is {mass:g}; it must not be negative (kg)")
    touches = [str(x) for x in list_of(fields, "touch_links", inside)]
    return Attached(
        link, [x for x in shapes if isinstance(x, Shape)], touches, mass or None, inside
    )


def _base(fields: dict[str, Any], frames: dict[str, Pose], called: str) -> Pose | None:
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
    outer = placed_in(joints, frames, inside)
    return compose(outer, pose_of(transforms[0], inside, _TRANSFORM))
