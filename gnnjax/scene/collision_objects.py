"""MoveIt's collision objects (moveit_msgs/CollisionObject): primitives, planes and meshes."""

from typing import Any, NamedTuple

import numpy as np

from gnnjax.errors import InputError, brief
from gnnjax.scene.messages import components, fields_of, list_of, numbers, pose_of
from gnnjax.scene.pose import IDENTITY, Pose, compose, moved, moved_points
from gnnjax.scene.shapes import Shape, box, cylinder, half_space, sphere

_OBJECT = (
    "header id type pose primitives primitive_poses meshes mesh_poses planes plane_poses "
    "subframe_names subframe_poses operation"
).split()
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


def frame_id(message: dict, called: str) -> str:
    """The frame that a message's header names."""
    known = ("frame_id", "stamp", "seq")
    header = fields_of(message.get("header"), known, f"header of {called}")
    return str(header.get("frame_id") or "").lstrip("/")


def placed_in(message: dict, frames: dict[str, Pose], called: str) -> Pose:
    """The pose of the frame that a message's header names."""
    name = frame_id(message, called)
    if name not in frames:
        raise InputError(
            f"{called} is in the frame {name!r}, and there are {sorted(frames)}; add it to "
            "fixed_frame_transforms"
        )
    return frames[name]


def shapes_of_object(value: Any, frames: dict[str, Pose], called: str) -> list[Shape | Surface]:
    """The obstacles of a collision object, in the frame that all of `frames` are given in."""
    fields = fields_of(value, _OBJECT, f"a collision object of {called}")
    inside = f"object {brief(fields.get('id', ''))} of {called}"
    if fields.get("operation") not in _ADD:
        raise InputError(
            f"{inside} has the operation {brief(fields['operation'])}; a scene has objects to add "
            "alone, so give it as it is in the end"
        )
    outer = placed_in(fields, frames, inside)
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
