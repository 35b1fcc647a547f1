"""Pictures: the arm along a path, seen in the scene."""

from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from gnnjax.errors import atomic_write
from gnnjax.kinematics import forward_kinematics
from gnnjax.robot import Robot
from gnnjax.scene import Scene, rotation_matrices

_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def draw_plan(robot: Robot, scene: Scene, path: np.ndarray, out: str | Path) -> None:
    """Draws boxes and the arm along a path, from start (blue) to goal (red), into a picture file.

    Drawn by matplotlib alone, which needs no display and no OpenGL.

    Args:
        robot: the arm.
        scene: its obstacles.
        path: `[L, D]` configurations.
        out: picture file; its ending chooses the format.
    """
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    shots = _along(path, 9)
    positions, rotations = (np.asarray(x) for x in forward_kinematics(robot, jnp.asarray(shots)))
    colors = matplotlib.colormaps["coolwarm"](np.linspace(0, 1, len(shots)))
    sphere = _unit_sphere()
    for column, azimuth in enumerate((-60, 30), start=1):
        axes = figure.add_subplot(1, 2, column, projection="3d")
        _draw_boxes(axes, scene)
        for shot, color in enumerate(colors):
            ends = shot in (0, len(shots) - 1)
            axes.plot(*positions[shot].T, color=color, linewidth=2.5, zorder=5)
            for g in range(len(robot.geom_radii)) if ends else ():
                body = robot.geom_bodies[g]
                if body < 0:
                    continue
                center = positions[shot, body] + rotations[shot, body] @ robot.geom_centers[g]
                surface = center[:, None, None] + robot.geom_radii[g] * sphere
                axes.plot_surface(*surface, color=color, alpha=0.25, linewidth=0, shade=True)
        axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(0, 1.5), xlabel="x [m]", ylabel="y [m]")
        axes.set_box_aspect((2, 2, 1.5))
        axes.view_init(elev=22, azim=azimuth)
    figure.suptitle(f"{robot.name}: from start (blue) to goal (red), {len(path)} configurations")
    atomic_write(out, lambda file: figure.savefig(file, dpi=130))


def _draw_boxes(axes, scene: Scene) -> None:
    rotations = np.asarray(rotation_matrices(jnp.asarray(scene.quats)))
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for i in np.flatnonzero(np.asarray(scene.mask)):
        corners = signs * np.asarray(scene.half_extents[i]) @ rotations[i].T
        corners = corners + np.asarray(scene.centers[i])
        faces = [corners[list(face)] for face in _FACES]
        axes.add_collection3d(
            Poly3DCollection(faces, facecolor="0.6", edgecolor="0.35", alpha=0.35, linewidth=0.5)
        )


def _along(path: np.ndarray, count: int) -> np.ndarray:
    """`count` configurations evenly spaced along a path by its length."""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    traveled = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0.0, traveled[-1], count)
    columns = [np.interp(at, traveled, path[:, d]) for d in range(path.shape[1])]
    return np.stack(columns, axis=1).astype(np.float32)


def _unit_sphere() -> np.ndarray:
    """`[3, 9, 13]` points on a unit sphere."""
    polar, around = np.meshgrid(
        np.linspace(0, np.pi, 9), np.linspace(0, 2 * np.pi, 13), indexing="ij"
    )
    return np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)])
