"""Triangles of what a viewer draws: obstacles of all kinds, and the links of arms.

Of an arm that is what MuJoCo's own viewer shows: geoms of the groups 0 to 2. A body that has none
of them, as those of URDFs, whose visual geometry is left out, is drawn as what it collides as.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.parts import quat_to_matrix
from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.scene.shapes import for_every_kind

_AROUND, _ALONG = 32, 9  # corners of a circle, and of a quarter of one
_PLATE = 1.5  # m; half the edge of what is drawn of a half-space
_SHOWN_GROUPS = 3  # the first of MuJoCo's groups of geoms, which its viewer shows
_Geom = mujoco.mjtGeom


class Mesh(NamedTuple):
    """Triangles, which run round as their outward normals have it."""

    vertices: np.ndarray  # [V 3] m
    faces: np.ndarray  # [F 3] of vertices


class Piece(NamedTuple):
    """What is drawn of a body, in one colour."""

    body: int  # of MuJoCo's model; 0 is the world
    rgba: tuple[float, float, float, float]
    mesh: Mesh  # in the body's frame


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes in one."""
    begin = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + first for mesh, first in zip(meshes, begin, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def _revolved(*strips: Sequence) -> Mesh:
    """What strips of (radius, height), from below upwards, sweep about the z axis. Each has
    vertices of its own, so that edges between them stay sharp."""
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    meshes = []
    for strip in strips:
        radius, height = np.array(strip, float).T
        x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
        z = np.broadcast_to(height[:, None], x.shape)
        low = np.arange((len(strip) - 1) * _AROUND).reshape(-1, _AROUND)
        beside, above = np.roll(low, -1, axis=1), low + _AROUND
        faces = [(low, beside, above), (beside, np.roll(above, -1, axis=1), above)]
        triangles = np.concatenate([np.stack(x, -1).reshape(-1, 3) for x in faces])
        vertices = np.stack([x, y, z], -1).reshape(-1, 3)
        # At the axis a circle is a point, and half of its triangles are none.
        a, b, c = np.moveaxis(vertices[triangles], 1, 0)
        real = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0
        meshes.append(Mesh(vertices, triangles[real]))
    return joined(meshes)


def box_mesh(half_extents: np.ndarray) -> Mesh:
    """A box, m; corners are there three times, so that edges stay sharp."""
    face = np.array([[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]], float)
    turns = [np.roll(face, axis, axis=1) for axis in range(3)]
    corners = np.concatenate([*turns, *(-turn[::-1] for turn in turns)])
    faces = 4 * np.arange(6)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(corners * half_extents, faces.reshape(-1, 3))


def ball_mesh(radius: float, half_length: float = 0.0) -> Mesh:
    """A ball, m, or a capsule: its halves pulled apart along z."""
    angle = np.linspace(0, np.pi / 2, _ALONG)
    sine, cosine = radius * np.sin(angle), radius * np.cos(angle)
    sine[0] = cosine[-1] = 0.0
    lower = list(zip(sine, -half_length - cosine, strict=True))
    upper = list(zip(sine[::-1], half_length + cosine[::-1], strict=True))
    return _revolved(lower + (upper if half_length else upper[1:]))


def cylinder_mesh(radius: float, half_length: float) -> Mesh:
    """A cylinder about z, m."""
    low, high = (radius, -half_length), (radius, half_length)
    return _revolved([(0, -half_length), low], [low, high], [high, (0, half_length)])


def _plate(height: float) -> Mesh:
    """The part of a plane that is drawn, from above."""
    corners = _PLATE * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    return Mesh(corners + np.array([0, 0, height]), np.array([[0, 1, 2], [0, 2, 3]]))


# Of an obstacle in its own frame, by its half extents [3] and radii [2], of disc and ball, m.
_OBSTACLES = for_every_kind(
    "viewer",
    box=lambda extents, radii: box_mesh(extents),
    sphere=lambda extents, radii: ball_mesh(radii[1]),
    capsule=lambda extents, radii: ball_mesh(radii[1], extents[2]),
    cylinder=lambda extents, radii: cylinder_mesh(radii[0], extents[2]),
    half_space=lambda extents, radii: _plate(extents[2]),
)


def obstacle_mesh(kind: str, half_extents: np.ndarray, radii: np.ndarray) -> Mesh:
    """An obstacle in its own frame; of a half-space, the part of its face nearest to the base.

    Args:
        kind: of `KINDS`.
        half_extents: `[3]` m, of the box.
        radii: `[2]` m, of disc and ball.
    """
    return _OBSTACLES[kind](np.asarray(half_extents, float), np.asarray(radii, float))


def _mesh_of_asset(model: mujoco.MjModel, mesh: int) -> Mesh:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    begin, number = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    corners = model.mesh_vert[first : first + count].astype(float)
    # Corners of its own for each triangle: smooth shading would hide the edges of hulls.
    corners = corners[model.mesh_face[begin : begin + number].ravel()]
    return Mesh(corners, np.arange(3 * number).reshape(-1, 3))


def _ellipsoid(size: np.ndarray) -> Mesh:
    ball = ball_mesh(1.0)
    return Mesh(ball.vertices * size, ball.faces)


# By sizes, as MuJoCo has them.
_PRIMITIVES = {
    _Geom.mjGEOM_BOX: box_mesh,
    _Geom.mjGEOM_SPHERE: lambda size: ball_mesh(size[0]),
    _Geom.mjGEOM_CAPSULE: lambda size: ball_mesh(size[0], size[1]),
    _Geom.mjGEOM_CYLINDER: lambda size: cylinder_mesh(size[0], size[1]),
    _Geom.mjGEOM_ELLIPSOID: _ellipsoid,
    _Geom.mjGEOM_PLANE: lambda size: _plate(0.0),
}


def geom_mesh(model: mujoco.MjModel, g: int) -> Mesh:
    """A geom of an arm, in the frame of its body.

    Raises:
        InputError: a height field, or another form that no arm has.
    """
    kind = _Geom(model.geom_type[g])
    if kind == _Geom.mjGEOM_MESH:
        mesh = _mesh_of_asset(model, int(model.geom_dataid[g]))
    elif kind in _PRIMITIVES:
        mesh = _PRIMITIVES[kind](model.geom_size[g])
    else:
        raise InputError(
            f"geom {g} of the arm is a {kind.name[7:].lower()}, which the viewer cannot draw; make "
            "it a mesh or primitives, or put it into group 3"
        )
    rotation = quat_to_matrix(model.geom_quat[g])
    return Mesh(mesh.vertices @ rotation.T + model.geom_pos[g], mesh.faces)


def shown_geoms(robot: Robot) -> list[int]:
    """Geoms of an arm's model that are drawn."""
    model = robot.mj_model
    shown = set(np.flatnonzero(model.geom_group < _SHOWN_GROUPS).tolist())
    dressed = {int(model.geom_bodyid[g]) for g in shown}
    bare = {g for g in robot.part_geoms.tolist() if int(model.geom_bodyid[g]) not in dressed}
    return sorted(shown | bare)


def arm_pieces(robot: Robot) -> list[Piece]:
    """All that is drawn of an arm: a piece for each colour of a body."""
    model = robot.mj_model
    found: dict[tuple[int, tuple[float, ...]], list[Mesh]] = {}
    for g in shown_geoms(robot):
        material = int(model.geom_matid[g])
        rgba = model.geom_rgba[g] if material < 0 else model.mat_rgba[material]
        key = int(model.geom_bodyid[g]), tuple(float(x) for x in rgba)
        found.setdefault(key, []).append(geom_mesh(model, g))
    return [Piece(body, rgba, joined(meshes)) for (body, rgba), meshes in found.items()]


def ghost_pieces(robot: Robot, rgba: tuple[float, float, float, float]) -> list[Piece]:
    """What moves of an arm, as what it collides as, in one colour."""
    model, found = robot.mj_model, dict[int, list[Mesh]]()
    for g in robot.part_geoms.tolist():
        if model.body_weldid[model.geom_bodyid[g]]:
            found.setdefault(int(model.geom_bodyid[g]), []).append(geom_mesh(model, g))
    return [Piece(body, rgba, joined(meshes)) for body, meshes in found.items()]
