"""Pictures: the arm along a path, seen in the scene."""

from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial import ConvexHull

from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import configurations_of
from gnnjax.errors import InputError
from gnnjax.files import atomic_write, check_target
from gnnjax.scene.allowed import last_link
from gnnjax.scene.scene import Scene, check_single, rotation_matrices
from gnnjax.scene.shapes import KINDS, for_every_kind, known_kinds

_MOST_POINTS = 5000  # of a cloud that are drawn
_BESIDE = 0.25  # of the arm's extent: how far beside it obstacles are in the picture
_PIECE = 0.08  # m; pieces in which obstacles are drawn
_OBSTACLE, _BASE = np.array([0.6, 0.6, 0.6, 0.35]), np.array([0.45, 0.45, 0.45, 0.9])
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def draw_plan(robot: Robot, scene: Scene, path: np.ndarray, out: str | Path) -> None:
    """Draws obstacles and the arm along a path, from start (blue) to goal (red), into a picture.

    Drawn by matplotlib alone, which needs no display and no OpenGL.

    Args:
        robot: the arm.
        scene: its obstacles.
        path: `[L, D]` configurations.
        out: picture file; its ending chooses the format.

    Raises:
        InputError: an ending that names no format; no path, as of a plan that failed; no scene,
            or several in one; an obstacle that is of no kind.
    """
    check_picture(out)
    check_single(scene)
    path = configurations_of(robot, "the path", path)
    if not len(path):
        raise InputError("the path is empty, as that of a plan that failed; there is none to draw")
    figure = Figure(figsize=(9, 4.4), layout="constrained")
    shots = _along(path, 7)
    positions, rotations = (np.asarray(x) for x in forward_kinematics(robot, jnp.asarray(shots)))
    along = forward_kinematics(robot, jnp.asarray(_along(path, 200)))
    tip = np.asarray(along[0])[:, last_link(robot)]
    colors = matplotlib.colormaps["coolwarm"](np.linspace(0, 1, len(shots)))
    parts, obstacles, drawn = _part_faces(robot), _obstacle_faces(scene), []
    still = (np.ptp(rotations, axis=0) < 1e-3).all(axis=(1, 2))  # on the way from start to goal
    still &= (np.ptp(positions, axis=0) < 1e-3).all(axis=1)
    for shot, color in enumerate(colors):
        color[3] = 0.9 if shot in (0, len(shots) - 1) else 0.12
        for body, faces in parts:
            placed = faces
            if body >= 0:
                placed = faces @ rotations[shot, body].T + positions[shot, body]
            if body >= 0 and not still[body]:
                drawn.append((placed, _shaded(placed, color)))
            elif shot == 0:
                drawn.append((placed, _shaded(placed, _BASE)))
    lower, upper = _limits([placed for placed, _ in drawn], [x for x, _ in obstacles], tip)
    faces, colors = (np.concatenate(x) for x in zip(*obstacles, *drawn, strict=True))
    for column, azimuth in enumerate((-60, 30), start=1):
        axes = figure.add_subplot(1, 2, column, projection="3d", computed_zorder=True)
        # All in one, or what is in front is not told face by face.
        axes.add_collection3d(Poly3DCollection(faces, facecolors=colors, linewidth=0))
        _draw_cloud(axes, scene)
        axes.plot(*tip.T, color="black", linewidth=1.2, linestyle=":")
        axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
        axes.locator_params(nbins=4)
        axes.set(xlabel="x [m]", ylabel="y [m]")
        axes.set_box_aspect(upper - lower, zoom=1.15)
        axes.view_init(elev=22, azim=azimuth)
    figure.suptitle(
        f"{robot.name}: from start (blue) to goal (red) in {len(path) - 1} straight motions; "
        "dotted: the last link"
    )
    atomic_write(out, lambda file: figure.savefig(file, dpi=130))


def _limits(
    arm: list[np.ndarray], obstacles: list[np.ndarray], tip: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corners `[3]` m of what a picture shows, the base in its middle: the arm wherever it is
    drawn, the way of its tip, and obstacles as far as they are near."""
    own = np.concatenate([*(faces.reshape(-1, 3) for faces in arm), tip])
    lower, upper = own.min(axis=0), own.max(axis=0)
    margin = _BESIDE * (upper - lower).max()
    others = [faces.reshape(-1, 3).clip(lower - margin, upper + margin) for faces in obstacles]
    shown = np.concatenate([own, *others])
    side = np.abs(shown[:, :2]).max()
    lower, upper = shown[:, 2].min(), shown[:, 2].max()
    return np.array([-side, -side, lower]), np.array([side, side, upper])


def draw_cover(robot: Robot, out: str | Path) -> None:
    """Draws an arm at home into a picture file: its parts, and the spheres that enclose them."""
    check_picture(out)
    positions, rotations = (
        np.asarray(x) for x in forward_kinematics(robot, jnp.asarray(robot.home))
    )
    positions = np.concatenate([positions, np.zeros((1, 3))])  # the last is the world
    rotations = np.concatenate([rotations, np.eye(3)[None]])
    sphere = _unit_sphere()
    light = 0.7 + 0.3 * sphere.mean(axis=1) @ (0.3, -0.5, 0.8)
    figure = Figure(figsize=(9, 5), layout="constrained")
    bodies = robot.sphere_bodies
    centers = np.einsum("gij,gj->gi", rotations[bodies], robot.sphere_centers) + positions[bodies]
    radii = robot.sphere_radii
    surfaces = centers[:, None, None] + radii[:, None, None, None] * sphere
    lower, upper = (centers - radii[:, None]).min(axis=0), (centers + radii[:, None]).max(axis=0)
    for column, title in enumerate(("parts", "with their spheres"), start=1):
        axes = figure.add_subplot(1, 2, column, projection="3d", title=title)
        for part in robot.parts:
            corners = part.vertices @ rotations[part.body].T + positions[part.body]
            if len(corners) < 4:
                faces = (corners[:, None, None] + part.radius * sphere).reshape(-1, 4, 3)
            else:
                faces = corners[ConvexHull(corners, qhull_options="QJ").simplices]
            axes.add_collection3d(
                Poly3DCollection(faces, facecolor="0.7", edgecolor="0.5", linewidth=0.1)
            )
        if column == 2:
            shaded = np.tile(light, len(centers))[:, None] * (0.2, 0.6, 0.9)
            axes.add_collection3d(
                Poly3DCollection(
                    surfaces.reshape(-1, 4, 3), facecolors=shaded, alpha=0.12, linewidth=0
                )
            )
        axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
        axes.set_box_aspect(upper - lower)
        axes.set_axis_off()
    figure.suptitle(f"{robot.name}: {len(robot.sphere_radii)} spheres")
    atomic_write(out, lambda file: figure.savefig(file, dpi=130))


def check_picture(out: str | Path) -> Path:
    """Returns the path of a picture that can be written.

    Raises:
        InputError: a folder, or an ending that names no format.
    """
    known = sorted(FigureCanvasBase.get_supported_filetypes())
    path = check_target(out)
    if path.suffix.lower().removeprefix(".") not in known:
        raise InputError(f"picture {str(out)!r} has no known ending; there are {known}")
    return path


def _part_faces(robot: Robot) -> list[tuple[int, np.ndarray]]:
    """Of each of the arm's parts: its body, and faces `[F, 4, 3]` m in the body's frame."""
    found = []
    for part in robot.parts:
        if part.radius > 0:
            # About each of its vertices, which are few, and those between two.
            middles = part.vertices
            if len(middles) == 2:
                middles = np.linspace(middles[0], middles[1], 9)
            faces = (middles[:, None, None] + part.radius * _unit_sphere()).reshape(-1, 4, 3)
        else:
            hull = ConvexHull(part.vertices, qhull_options="QJ")
            faces = part.vertices[hull.simplices]
            # Corners run round each face as its outward normal has it.
            normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
            inwards = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0
            faces[inwards] = faces[inwards][:, ::-1]
            # Four corners like the others': matplotlib does not fill up what is shorter.
            faces = np.concatenate([faces, faces[:, 2:]], axis=1)
        found.append((part.body, faces))
    return found


def _shaded(faces: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Colours `[F, 4]` of faces, by how they face the light."""
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = 0.7 + 0.3 * normals @ (0.3, -0.5, 0.8)
    return np.clip(np.c_[light[:, None] * color[:3], np.full(len(faces), color[3])], 0, 1)


def _cut_up(faces: np.ndarray) -> np.ndarray:
    """The same faces `[F, 4, 3]` in pieces, of which each is wholly before or behind others."""
    found = []
    for face in faces:
        sides = np.linalg.norm(face - np.roll(face, 1, axis=0), axis=1)
        across, along = (
            np.ceil(max(x) / _PIECE).astype(int) + 1 for x in (sides[::2], sides[1::2])
        )
        v, u = np.meshgrid(np.linspace(0, 1, across), np.linspace(0, 1, along), indexing="ij")
        weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1)
        grid = weights @ face
        corners = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
        found.append(np.stack(corners, axis=2).reshape(-1, 4, 3))
    return np.concatenate(found)


def _draw_box(half_extents: np.ndarray, radii: np.ndarray) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return (signs * half_extents)[np.array(_FACES)]


def _draw_ball(half_extents: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """A sphere, or a capsule: its halves pulled apart."""
    faces = radii[1] * _unit_sphere()
    faces[..., 2] += np.sign(faces[..., 2]) * half_extents[2]  # no corner is in the middle
    return faces


def _draw_cylinder(half_extents: np.ndarray, radii: np.ndarray) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 25)
    rim = radii[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low, high = (np.c_[rim, np.full(25, z)] for z in (-half_extents[2], half_extents[2]))
    side = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    caps = [
        np.stack([end[:-1], end[1:], 0 * end[1:] + [0, 0, z], end[:-1]], axis=1)
        for end, z in ((low, -half_extents[2]), (high, half_extents[2]))
    ]
    return np.concatenate([side, *caps])


def _draw_half_space(half_extents: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """The part of its plane that the picture shows."""
    corners = np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]], float)
    return (corners + np.array([0, 0, half_extents[2]]))[None]


# Faces `[F, 4, 3]` m of an obstacle in its own frame, by its half extents and radii.
_DRAW = for_every_kind(
    "picture",
    box=_draw_box,
    sphere=_draw_ball,
    capsule=_draw_ball,
    cylinder=_draw_cylinder,
    half_space=_draw_half_space,
)


def _draw_cloud(axes, scene: Scene) -> None:
    if scene.cloud is not None:
        points = np.asarray(scene.cloud.points)[: int(scene.cloud.num)]
        points = points[:: -(-len(points) // _MOST_POINTS) or 1]
        axes.scatter(*points.T, s=1, color="0.45", alpha=0.6, linewidth=0)


def _obstacle_faces(scene: Scene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Faces `[F, 4, 3]` m of each obstacle, and their colours `[F, 4]`."""
    found = []
    rotations = np.asarray(rotation_matrices(jnp.asarray(scene.quats)))
    kinds = known_kinds(scene.half_extents, scene.radii, scene.mask)
    for i in np.flatnonzero(np.asarray(scene.mask)):
        sizes = np.asarray(scene.half_extents[i]), np.asarray(scene.radii[i])
        faces = _DRAW[KINDS[kinds[i]]](*sizes) @ rotations[i].T + np.asarray(scene.centers[i])
        pieces = _cut_up(faces)
        found.append((pieces, _shaded(pieces, _OBSTACLE)))
    return found


def _along(path: np.ndarray, count: int) -> np.ndarray:
    """`count` configurations evenly spaced along a path by its length."""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    traveled = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0.0, traveled[-1], count)
    columns = [np.interp(at, traveled, path[:, d]) for d in range(path.shape[1])]
    return np.stack(columns, axis=1).astype(np.float32)


def _unit_sphere() -> np.ndarray:
    """`[F, 4, 3]` corners of the faces of a unit sphere."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, 8), np.linspace(0, 2 * np.pi, 13))
    grid = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)])
    grid = np.moveaxis(grid, 0, -1)
    corners = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.stack(corners, axis=2).reshape(-1, 4, 3)
