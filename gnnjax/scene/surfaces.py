"""Meshes and height fields as balls that enclose them, and the scenes of one cloud."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gnnjax.arm.mesh_files import unit_of
from gnnjax.errors import InputError, as_floats, check_number
from gnnjax.scene.cloud import MOST_METERS, RADIUS, Balls, point_cloud
from gnnjax.scene.cloud import VOXEL as CLOUD_VOXEL
from gnnjax.scene.numbers import rotation_of, vector_of
from gnnjax.scene.point_files import by_trimesh, points_from_file
from gnnjax.scene.scene import Scene, scene_from_shapes
from gnnjax.scene.shapes import IDENTITY_QUAT

VOXEL = 0.005  # m, unless told
INSIDE = 0.05  # m; no ball of this radius fits between those that fill a solid
_MOST_CELLS = 200  # along an edge of the lattice in which solids are filled
_MOST_SAMPLES = 20_000_000  # points on a surface


def mesh(
    file: str | Path,
    center: Sequence | np.ndarray = (0, 0, 0),
    quat: Sequence | np.ndarray = IDENTITY_QUAT,
    scale: float = 1.0,
    voxel: float = VOXEL,
    solid: bool | None = None,
) -> Balls:
    """A mesh, convex or not, enclosed by balls that stand out of it by two voxels at most.

    An open mesh is its surface. A closed one is solid: what is enclosed is filled so that no ball
    of `INSIDE` (or of two voxels, or a hundredth of the mesh, if that is more) has room there.

    Args:
        file: STL, OBJ, PLY or another format that trimesh reads. One that was cut off is refused,
            but for an OBJ between two lines, which is a whole one with fewer faces.
        center: where the mesh's origin is in the frame of the arm's base, m.
        quat: its orientation w x y z.
        scale: metres of the file's unit; 0.001 for millimetres. A COLLADA file names its own, which
            is made metres of; this is beside it.
        voxel: edge of those that each have one ball, m.
        solid: whether the mesh must be closed, or is its surface in any case; None takes it as it
            is.

    Raises:
        InputError: no such file, no mesh in it, an open one with `solid`, one too large for such
            small voxels, a scale or voxel that is not positive.
    """
    called = f"mesh {str(file)!r}"
    check_number(scale, f"scale of {called}")
    if not 0 < scale < np.inf:
        raise InputError(f"scale of {called} is {scale}; it must be positive")
    loaded = by_trimesh(Path(file), called, "mesh")
    vertices, faces = np.asarray(loaded.vertices, float), np.asarray(loaded.faces)
    rotation = rotation_of(quat, called)
    placed = scale * unit_of(Path(file)) * vertices @ rotation.T + vector_of(
        center, f"center of {called}"
    )
    return enclosed(placed, faces, voxel, solid, source=called)


def height_field(
    heights: Sequence | np.ndarray,
    size: Sequence,
    center: Sequence | np.ndarray = (0, 0, 0),
    quat: Sequence | np.ndarray = IDENTITY_QUAT,
    depth: float = 0.1,
    voxel: float = VOXEL,
) -> Balls:
    """A height field with all that is below it, enclosed as a closed `mesh` is.

    Args:
        heights: `[R, C]` m along z; rows are along y, columns along x.
        size: from the first to the last column, and from the first to the last row, m.
        center: of the field in the frame of the arm's base, m.
        quat: its orientation w x y z.
        depth: how far it goes on below the least height, m.
        voxel: edge of those that each have one ball, m.

    Raises:
        InputError: fewer than 2 x 2 heights, numbers that are not finite, sizes that are not
            positive.
    """
    called = "the height field"
    try:
        array = as_floats(heights)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"heights of {called} are not numbers; give [R, C]") from None
    if array.ndim != 2 or min(array.shape) < 2:
        raise InputError(
            f"heights of {called} have shape {array.shape}; give [R, C], 2 x 2 or more"
        )
    if not (np.abs(array) <= MOST_METERS).all():
        raise InputError(f"heights of {called} must be finite, and below {MOST_METERS:g} m")
    check_number(depth, f"depth of {called}")
    across, along = vector_of(size, f"size of {called}", 2)
    if not (across > 0 and along > 0 and 0 < depth < np.inf):
        raise InputError(f"size {size} and depth {depth} of {called} must be positive (m)")
    rows, columns = array.shape
    x, y = np.meshgrid(
        np.linspace(-across / 2, across / 2, columns),
        np.linspace(-along / 2, along / 2, rows),
    )
    bottom = np.full(array.shape, array.min() - depth)
    vertices = np.concatenate(
        [np.stack([x, y, z], axis=-1).reshape(-1, 3) for z in (array, bottom)]
    )
    number = np.arange(2 * array.size).reshape(2, rows, columns)
    top, below = number
    quads = [_quads(top), _quads(below)]
    for edge in (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]):
        quads.append(_quads(np.stack([top[edge], below[edge]])))
    rotation = rotation_of(quat, called)
    placed = vertices @ rotation.T + vector_of(center, f"center of {called}")
    # Closed, though its faces are not all turned outwards.
    return _covered(placed, np.concatenate(quads), voxel, True, called)


def _quads(number: np.ndarray) -> np.ndarray:
    """Triangles between neighbours of a lattice of vertices."""
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    return np.concatenate(
        [np.stack([a, b, d], axis=-1).reshape(-1, 3), np.stack([a, d, c], axis=-1).reshape(-1, 3)]
    )


def enclosed(
    vertices: np.ndarray,
    faces: np.ndarray,
    voxel: float = VOXEL,
    solid: bool | None = None,
    *,
    source: str = "the mesh",
) -> Balls:
    """`mesh` of vertices `[V, 3]`, m, in the frame of the arm's base, and faces `[F, 3]`."""
    if not len(faces) or not len(vertices):
        raise InputError(f"{source} has no faces; points alone are a point_cloud")
    if not (np.abs(vertices) <= MOST_METERS).all():
        raise InputError(
            f"{source} has vertices that are not finite or beyond {MOST_METERS:g} m; mend it"
        )
    closed = _is_closed(vertices, faces)
    if solid and not closed:
        raise InputError(
            f"{source} is not closed, so that it has no inside; close it, or take its surface with "
            "solid=None"
        )
    return _covered(vertices, faces, voxel, closed and solid is not False, source)


def _is_closed(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether each edge is one of two faces, or of another even number."""
    # STL files have each face's corners for themselves.
    _, same = np.unique(vertices, axis=0, return_inverse=True)
    corners = same.reshape(-1)[faces]
    corners = corners[(np.diff(np.sort(corners, axis=1), axis=1) > 0).all(axis=1)]
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]))
    _, count = np.unique(edges, axis=0, return_counts=True)
    return bool(len(count)) and bool((count % 2 == 0).all())


def _covered(
    vertices: np.ndarray, faces: np.ndarray, voxel: float, filled: bool, source: str
) -> Balls:
    check_number(voxel, f"voxel of {source}")
    if not 0 < voxel < np.inf:
        raise InputError(f"voxel of {source} is {voxel}; it must be positive (m)")
    extent = vertices.max(axis=0) - vertices.min(axis=0)
    cell = max(voxel, float(extent.max()) / _MOST_CELLS)
    spacing = voxel / 2
    samples = _samples(vertices[faces], spacing, source)
    # Where three points are no farther apart than `spacing`, one of them is that near to all that
    # is between them: at one of three angles of which each is 120 degrees or more, were it not.
    shell = point_cloud(samples, spacing / np.sqrt(3), voxel, source=source)
    if not filled:
        return shell
    return Balls(np.concatenate([shell.points, _inside(samples, cell)]), shell.radius)


def _samples(triangles: np.ndarray, spacing: float, source: str) -> np.ndarray:
    """Points of triangles `[F, 3, 3]`, which they cut into smaller ones with edges of `spacing` at
    most."""
    edges = triangles - np.roll(triangles, 1, axis=1)
    longest = np.sqrt((edges**2).sum(axis=2)).max(axis=1)
    parts = np.maximum(1, np.ceil(longest / spacing)).astype(np.int64)
    total = int(((parts + 1) * (parts + 2) // 2).sum())
    if total > _MOST_SAMPLES:
        raise InputError(
            f"{source} takes {total} points {1e3 * spacing:g} mm apart, more than {_MOST_SAMPLES}; "
            "choose a larger voxel, or check its unit"
        )
    found = []
    for count in np.unique(parts):
        first, second = np.triu_indices(count + 1)
        weights = np.stack([first, second - first, count - second], axis=1) / count
        found.append((weights @ triangles[parts == count]).reshape(-1, 3))
    return np.concatenate(found)


def _inside(samples: np.ndarray, cell: float) -> np.ndarray:
    """Points inside of a closed surface, of which enough samples are given, on a lattice.

    Cells that hold samples part inside from outside: what joins the centres of two others that are
    neighbours does not cross the surface, or a sample would be nearer than the end of these cells.
    """
    lower = samples.min(axis=0) - 1.5 * cell
    index = np.floor((samples - lower) / cell).astype(int)
    wall = np.zeros(index.max(axis=0) + 2, bool)
    wall[tuple(index.T)] = True
    from scipy import ndimage  # a tenth of a second, for this alone

    hollow = ndimage.binary_fill_holes(wall) & ~wall
    # Every so many cells, so that no centre of a ball of `INSIDE` is farther from all of them.
    every = max(1, int(2 * (INSIDE / np.sqrt(3) - cell) / cell))
    chosen = np.zeros_like(hollow)
    chosen[::every, ::every, ::every] = True
    return lower + (np.argwhere(hollow & chosen) + 0.5) * cell


def scene_from_points(
    points: Sequence | np.ndarray | str | Path,
    radius: float = RADIUS,
    voxel: float | None = CLOUD_VOXEL,
) -> Scene:
    """A scene of a `point_cloud`: an array `[K, 3]`, m, or a file for `points_from_file`."""
    if isinstance(points, str | Path):
        balls = point_cloud(points_from_file(points), radius, voxel, source=repr(str(points)))
        return scene_from_shapes([], clouds=[balls], source=repr(str(points)))
    return scene_from_shapes([], clouds=[point_cloud(points, radius, voxel)])


def scene_from_mesh(file: str | Path, **placed: Any) -> Scene:
    """A scene of one mesh, whose further arguments are those of `mesh`."""
    return scene_from_shapes([], clouds=[mesh(file, **placed)], source=repr(str(file)))


def scene_from_height_field(heights: Sequence | np.ndarray, size: Sequence, **placed: Any) -> Scene:
    """A scene of one height field, whose further arguments are those of `height_field`."""
    return scene_from_shapes([], clouds=[height_field(heights, size, **placed)])
