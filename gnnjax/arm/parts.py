"""What an arm collides as: convex parts, one for each collision geom of its model.

A part is the convex hull of points, made thicker by a ball. Spheres, capsules, boxes and meshes,
which MuJoCo collides as their hulls, are such parts exactly. Cylinders and ellipsoids are not;
their parts are polytopes around them.
"""

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.errors import InputError

SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)

# m; by how much a polytope around a cylinder or an ellipsoid may stand out of it, along the radius.
_EXCESS = 5e-4
_SMALL_MESH = 16  # vertices; no fewer than those below which MuJoCo looks at all, 9
_MOST_DIVISIONS = 4  # with this excess for ellipsoids of up to 0.4 m half length


class Part(NamedTuple):
    """A convex part of an arm: the hull of points, and all that is within `radius` of it."""

    name: str
    body: int  # index into `Robot.bodies`, -1 for the world
    vertices: np.ndarray  # [V 3] m, in the body's frame
    radius: float  # m


def part_of_geom(model: mujoco.MjModel, g: int, path: Path) -> Part:
    """The part that a geom is.

    Raises:
        InputError: a geom that has no hull.
    """
    kind = int(model.geom_type[g])
    name = geom_name(model, g)
    if kind not in _VERTICES:
        raise InputError(
            f"collision geom {name} of {str(path)!r} is a {mujoco.mjtGeom(kind).name[7:].lower()}; "
            "make it a mesh or primitives, or let it collide with nothing (contype=0 conaffinity=0)"
        )
    vertices, radius = _VERTICES[kind](model, g)
    placed = vertices @ quat_to_matrix(model.geom_quat[g]).T + model.geom_pos[g]
    return Part(name, int(model.geom_bodyid[g]) - 1, placed, radius)


def quat_to_matrix(quat: np.ndarray) -> np.ndarray:
    """The rotation [3 3] of a quaternion, w x y z, with exact zeros and ones."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    # Quaternions such as (0, 0, 1, 1)/sqrt(2) leave 1e-17 where 0 is meant; exact zeros let the
    # kernel generator drop the terms.
    matrix[np.abs(matrix) < 1e-12] = 0.0
    matrix[np.abs(np.abs(matrix) - 1.0) < 1e-12] = np.sign(matrix)[
        np.abs(np.abs(matrix) - 1.0) < 1e-12
    ]
    return matrix.reshape(3, 3)


def geom_name(model: mujoco.MjModel, g: int) -> str:
    """How messages call a geom."""
    body = model.body(int(model.geom_bodyid[g])).name
    return model.geom(g).name or (f"number {g} of {body}" if body else f"number {g}")


def _sphere(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, float]:
    return np.zeros((1, 3)), float(model.geom_size[g, 0])


def _capsule(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, float]:
    end = np.array([0.0, 0.0, model.geom_size[g, 1]])
    return np.stack([-end, end]), float(model.geom_size[g, 0])


def _box(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, float]:
    corners = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return corners * model.geom_size[g], 0.0


def _cylinder(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, float]:
    radius, half = model.geom_size[g, :2]
    sides = max(8, int(np.ceil(np.pi / np.arccos(radius / (radius + _EXCESS)))))
    angles = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius / np.cos(np.pi / sides)
    ends = np.repeat([half, -half], sides)
    return np.column_stack([np.tile(ring, (2, 1)), ends]), 0.0


def _ellipsoid(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, float]:
    size = model.geom_size[g]
    around = _around_ball(0)
    for divisions in range(1, _MOST_DIVISIONS + 1):
        if (np.linalg.norm(around, axis=1).max() - 1) * size.max() <= _EXCESS:
            break
        around = _around_ball(divisions)
    return around * size, 0.0  # which takes what is around the ball to what is around its image


def _around_ball(divisions: int) -> np.ndarray:
    """Corners [V 3] of a polytope around the unit ball: an icosahedron, divided and blown up."""
    from scipy.spatial import ConvexHull  # half a second, for ellipsoids alone

    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)])
    corners = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)])
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    for _ in range(divisions):
        faces = corners[ConvexHull(corners).simplices]
        middles = (faces + np.roll(faces, 1, axis=1)).reshape(-1, 3) / 2
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        corners = np.concatenate([corners, middles])
        corners = corners[np.unique(corners.round(9), axis=0, return_index=True)[1]]
    return corners / -ConvexHull(corners).equations[:, 3].max()


def _mesh(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, float]:
    mesh = int(model.geom_dataid[g])
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[first : first + count].astype(float)
    graph = int(model.mesh_graphadr[mesh])
    # Of its hull: the number of vertices and of faces, and after one row the vertices. Where the
    # file wants fewer of these (`maxhullvert`), MuJoCo still collides all that a small mesh has.
    if graph >= 0 and len(vertices) > _SMALL_MESH:
        count = int(model.mesh_graph[graph])
        vertices = vertices[model.mesh_graph[graph + 2 + count : graph + 2 + 2 * count]]
    return vertices, 0.0


_VERTICES = {
    SPHERE: _sphere,
    CAPSULE: _capsule,
    _BOX: _box,
    _CYLINDER: _cylinder,
    _ELLIPSOID: _ellipsoid,
    _MESH: _mesh,
}
