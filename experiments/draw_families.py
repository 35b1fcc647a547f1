"""Draws one problem of each family: the picture `docs/families.png`.

MUJOCO_GL=egl python -m experiments.draw_families
"""

import dataclasses
from pathlib import Path

import jax
import matplotlib
import mujoco
import numpy as np
from matplotlib.figure import Figure

from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.errors import run_command
from gnnjax.files import atomic_write
from gnnjax.problems.families import FAMILIES
from gnnjax.problems.labelled import generate_labelled, problem_keys
from gnnjax.problems.problem import Problem
from gnnjax.scene.mujoco_world import build_world, obstacles, place_obstacles
from gnnjax.scene.shapes import cylinder

TITLES = {
    "paper": "paper: 2 to 9 boxes",
    "shelf": "shelf: compartment to compartment, or out",
    "table": "table: end to end, among objects",
    "window": "window: through the wall",
    "clutter": "clutter: blocks, pillars, plates",
    "bin": "bin: in or out",
    "cans": "cans: gap to gap, or out",
    "pipes": "pipes: among them",
    "cloud_shelf": "cloud_shelf: what a camera sees of a shelf",
    "upright": "upright: shelf, with a bottle",
}
# Crosswise on the flange.
_BOTTLE = cylinder([0, 0, 0.085], radius=0.035, half_length=0.1, quat=[0.5**0.5, 0, 0.5**0.5, 0])
_START, _GOAL = (0.25, 0.45, 0.85, 1.0), (0.85, 0.3, 0.25, 1.0)


@dataclasses.dataclass(frozen=True)
class DrawConfig:
    """Draw one problem of each family, start in blue and goal in red."""

    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF."""
    index: int = 0
    """Which of the test problems."""
    holder: str = "link_7"
    """Body that holds the bottle of the family upright, 85 mm along its z axis."""
    out: Path = Path("docs/families.png")
    """Picture file."""


def draw_families(config: DrawConfig) -> None:
    """Renders a panel a family with MuJoCo, and writes them as one picture."""
    alone = load_robot(config.robot)
    figure = Figure(figsize=(9, 12.8), layout="constrained")
    for place, (family, title) in enumerate(TITLES.items(), start=1):
        robot = alone.attach(config.holder, [_BOTTLE]) if family == "upright" else alone
        keys = problem_keys(0, "test", config.index, 1, family)
        drawn = generate_labelled(robot, 0, family=family)(keys)
        assert isinstance(drawn, Problem)
        problem = jax.tree.map(lambda x: np.asarray(x[0]), drawn)
        axes = figure.add_subplot(4, 3, place)
        axes.imshow(_render(robot, problem, on_one_side=family in FAMILIES))
        axes.set_title(title, fontsize=9)
        axes.axis("off")
    atomic_write(config.out, lambda file: figure.savefig(file, dpi=120, format="png"))


def _render(robot: Robot, problem: Problem, on_one_side: bool) -> np.ndarray:
    """The scene with the arm at start and at goal, looked at past the arm."""
    scene = problem.scene
    model = build_world(robot, len(scene.mask), scene.cloud)
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene)
    model.geom_rgba[obstacles(model, len(scene.mask)).geoms, 3] = 0.45
    model.vis.global_.offwidth, model.vis.global_.offheight = 640, 600
    # Boxes that do not exist are far away, and would move the near clipping plane.
    model.stat.extent = 2.0
    model.vis.headlight.ambient[:] = 0.35
    option = mujoco.MjvOption()
    option.geomgroup[:] = 1
    places = scene.centers[scene.mask]
    if scene.cloud is not None:
        places = np.concatenate([places, scene.cloud.points[: scene.cloud.num]])
    middle = places.mean(axis=0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.4 * middle[0], 0.4 * middle[1], 0.55]
    camera.distance, camera.elevation = 3.0, -28
    # Past the arm, into what stands beside it.
    camera.azimuth = np.degrees(np.arctan2(middle[1], middle[0])) + 40 if on_one_side else 60
    moving = np.flatnonzero(model.geom_bodyid > 0)
    moving = moving[model.body_mocapid[model.geom_bodyid[moving]] < 0]
    with mujoco.Renderer(model, 600, 640) as renderer:
        for q, color in ((problem.start, _START), (problem.goal, _GOAL)):
            data.qpos[:] = q
            mujoco.mj_forward(model, data)
            model.geom_rgba[moving] = color
            if color is _START:
                renderer.update_scene(data, camera, option)
            else:
                _add_arm(renderer.scene, model, data, moving)
        _add_backdrop(renderer.scene)
        return renderer.render()


def _add_arm(shown: mujoco.MjvScene, model, data, geoms: np.ndarray) -> None:
    """Adds an arm's geoms, where they are now, to what is rendered."""
    for g in geoms:
        geom = shown.geoms[shown.ngeom]
        mujoco.mjv_initGeom(
            geom,
            int(model.geom_type[g]),
            model.geom_size[g],
            data.geom_xpos[g],
            data.geom_xmat[g],
            model.geom_rgba[g],
        )
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            geom.dataid = 2 * model.geom_dataid[g]  # as the renderer has it
        shown.ngeom += 1


def _add_backdrop(shown: mujoco.MjvScene) -> None:
    """Adds a white wall behind all that is seen."""
    camera = shown.camera[0]
    forward, up = camera.forward.astype(float), camera.up.astype(float)
    axes = np.stack([np.cross(forward, up), up, forward], axis=1)
    wall = shown.geoms[shown.ngeom]
    box, size = int(mujoco.mjtGeom.mjGEOM_BOX), np.array([20.0, 20.0, 0.01])
    mujoco.mjv_initGeom(
        wall, box, size, camera.pos + 8.0 * forward, axes.ravel(), np.ones(4, np.float32)
    )
    wall.emission = 1.0
    shown.ngeom += 1


if __name__ == "__main__":
    matplotlib.use("agg")
    run_command(lambda: draw_families(parse_arguments(DrawConfig)))
