"""Draws the pictures of `docs/concepts.md`, most of them of an arm of two joints, whose
configurations are points of a plane.

python -m experiments.draw_concepts
"""

import dataclasses
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from gnnjax.arguments import parse_arguments
from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.clearances import clearances
from gnnjax.errors import run_command
from gnnjax.files import atomic_write
from gnnjax.guide.field import field_guide, reach_grid
from gnnjax.planning.load import load_planner
from gnnjax.plot import draw_cover
from gnnjax.roadmap.graph import GOAL, START, Roadmap, default_radius, each_edge
from gnnjax.roadmap.stored import insert_ends, stored_roadmap
from gnnjax.scene.scene import Scene, scene_from_shapes
from gnnjax.scene.shapes import box
from gnnjax.trajectory.states import sample_trajectory

PLANAR = """
<mujoco model="planar">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 0 1" range="-3.1 3.1"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.04"/>
      <body name="fore" pos="0.5 0 0">
        <joint name="elbow" axis="0 0 1" range="-2.8 2.8"/>
        <geom type="capsule" fromto="0 0 0 0.45 0 0" size="0.03"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
_BOXES = (((0.55, 0.45), (0.12, 0.08)), ((-0.1, 0.72), (0.08, 0.16)), ((0.5, -0.55), (0.06, 0.2)))
_SLOT = ((0.8, 0.004), (0.03, 0.004))  # a thin plate, which samples step over
_START, _GOAL = np.array([-1.9, 0.9]), np.array([1.4, -2.2])
_NODES = 120


@dataclasses.dataclass(frozen=True)
class DrawConfig:
    """Draw the pictures of the concepts."""

    out: Path = Path("docs/pictures")
    """Folder of the pictures."""


def draw_concepts(config: DrawConfig) -> None:
    """Writes all of them."""
    file = Path(mkdtemp()) / "planar.xml"
    file.write_text(PLANAR, encoding="utf-8")
    robot = load_robot(file)
    scene = scene_from_shapes([_box(each) for each in _BOXES])
    config.out.mkdir(exist_ok=True)
    figures = {
        "roadmap.png": _roadmap(robot, scene),
        "guide.png": _guide(robot, scene),
        "certificate.png": _certificate(robot),
        "trajectory.png": _trajectory(),
    }
    for name, figure in figures.items():
        atomic_write(config.out / name, lambda file, figure=figure: figure.savefig(file, dpi=90))
    draw_cover(load_robot("kuka_iiwa14"), config.out / "geometry.png")


def _box(flat: tuple) -> Any:
    (x, y), (a, b) = flat
    return box([x, y, 0.0], [a, b, 0.1])


def _joined(robot: Robot) -> Roadmap:
    stored = stored_roadmap(robot, _NODES, 0)
    return insert_ends(stored, _START, _GOAL, default_radius(robot, _NODES + 2))


def _edges(roadmap: Roadmap) -> np.ndarray:
    """`[E 2]` nodes of each edge, once."""
    edges = each_edge(roadmap)
    return np.stack([edges.first, edges.second], axis=1)


def _plane(robot: Robot, scene: Scene, axes: Axes) -> None:
    """Configurations that are blocked, grey."""
    sides = [np.linspace(low, high, 160) for low, high in zip(*_limits(robot), strict=True)]
    q = np.stack(np.meshgrid(*sides), axis=-1)
    blocked = clearances(robot, scene, q.reshape(-1, 2)).reshape(q.shape[:2]) <= 0
    axes.contourf(*sides, blocked, levels=[0.5, 1.5], colors=["0.8"])
    axes.set(xlabel="shoulder [rad]", ylabel="elbow [rad]")


def _limits(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    return robot.joint_lower, robot.joint_upper


def _workspace(robot: Robot, axes: Axes, path: np.ndarray, obstacles: tuple = _BOXES) -> None:
    for (x, y), (a, b) in obstacles:
        axes.add_patch(Rectangle((x - a, y - b), 2 * a, 2 * b, color="0.55"))
    shades = np.linspace(0.25, 1.0, len(path))
    for q, shade in zip(path, shades, strict=True):
        joint = np.asarray(forward_kinematics(robot, jnp.asarray(q))[0])[-1, :2]
        tip = joint + 0.45 * np.array([np.cos(q.sum()), np.sin(q.sum())])
        line = np.stack([np.zeros(2), joint, tip])
        axes.plot(*line.T, color="tab:blue", alpha=shade, linewidth=5, solid_capstyle="round")
    axes.set(xlim=(-1.0, 1.0), ylim=(-1.0, 1.0), xticks=(-1, -0.5, 0, 0.5, 1))
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def _between(path: np.ndarray, num: int) -> np.ndarray:
    """`[num D]` configurations along a path, evenly."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.linspace(0, length[-1], num)
    return np.stack([np.interp(at, length, column) for column in path.T], axis=1)


def _roadmap(robot: Robot, scene: Scene) -> Figure:
    plan = load_planner(robot.path).plan(scene, _START, _GOAL)
    roadmap = _joined(robot)
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    _workspace(robot, left, _between(plan.path, 9))
    left.set_title("the arm along the path that is found")
    _plane(robot, scene, right)
    nodes = np.asarray(roadmap.nodes)
    right.add_collection(LineCollection(nodes[_edges(roadmap)], color="0.5", linewidth=0.4))
    right.plot(*nodes[2 : _NODES + 2].T, ".", color="0.3", markersize=3)
    right.plot(*plan.path.T, color="tab:blue", linewidth=2.5)
    for name, q in (("start", nodes[START]), ("goal", nodes[GOAL])):
        right.plot(*q, "o", color="tab:red")
        right.annotate(name, q, xytext=(5, 5), textcoords="offset points")
    right.set_title("a stored roadmap; blocked is grey")
    return figure


def _guide(robot: Robot, scene: Scene) -> Figure:
    guide, grid = field_guide(robot), reach_grid(robot)
    reading = jax.jit(guide.read)(guide.weights, scene)
    prices = guide.prices(guide.weights, reading)
    roadmap = _joined(robot)
    nodes, edges = np.asarray(roadmap.nodes), _edges(roadmap)
    price = np.asarray(
        jax.jit(prices.motions, static_argnums=2)(nodes[edges[:, 0]], nodes[edges[:, 1]], 16)
    )
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    field = np.asarray(reading).reshape(grid.shape)[:, :, grid.shape[2] // 2]
    ends = [low + n * grid.cell for low, n in zip(grid.lower, grid.shape, strict=True)]
    shown = left.imshow(
        field.T,
        origin="lower",
        extent=(grid.lower[0], ends[0], grid.lower[1], ends[1]),
        cmap="RdBu",
        vmin=-0.6,
        vmax=0.6,
    )
    figure.colorbar(shown, ax=left, label="distance to the obstacles [m]", shrink=0.8)
    for (x, y), (a, b) in _BOXES:
        left.add_patch(Rectangle((x - a, y - b), 2 * a, 2 * b, fill=False))
    left.set(title="the field, one value a cell", xlabel="x [m]", ylabel="y [m]")
    _plane(robot, scene, right)
    lines = LineCollection(nodes[edges], cmap="viridis_r", array=np.minimum(price, 6), linewidth=1)
    right.add_collection(lines)
    figure.colorbar(lines, ax=right, label="price, nats (6 and above alike)", shrink=0.8)
    right.set_title("what it says of the edges, none of them checked")
    return figure


def _certificate(robot: Robot) -> Figure:
    scene = scene_from_shapes([_box(_SLOT)])
    start, goal = np.array([-0.36, 0.0]), np.array([0.39, 0.0])
    fraction = np.linspace(0, 1, 2001)
    along = start + fraction[:, None] * (goal - start)
    length = fraction * np.linalg.norm(goal - start)
    clearance = clearances(robot, scene, along)
    moved = 0.95 + 0.03  # m a rad: the farthest point of the arm
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    _workspace(robot, left, along[:: len(along) // 15], (_SLOT,))
    left.set(title="a motion through a thin plate", xlim=(-0.1, 1.1), ylim=(-0.5, 0.5))
    right.axhline(0, color="0.6", linewidth=0.8)
    right.plot(length, clearance, color="tab:blue", label="clearance")
    pieces = [(0.0, length[-1])]
    while pieces:
        low, high = pieces.pop()
        middle = (low + high) / 2
        free = np.interp(middle, length, clearance)
        proven = free >= moved * (high - low) / 2
        if proven:
            peak = np.array([low, middle, high])
            right.fill_between(
                peak, free - moved * abs(peak - middle), alpha=0.25, color="tab:green"
            )
        elif high - low > 0.002:
            pieces += [(low, middle), (middle, high)]
    steps = np.arange(0, length[-1] + 0.05, 0.15)
    right.plot(steps, np.interp(steps, length, clearance), "o", color="tab:red", label="samples")
    right.set(title="free at all samples; pieces that are proven, green", ylim=(-0.05, 0.4))
    right.set(xlabel="along the motion [rad]", ylabel="[m]")
    right.legend()
    return figure


def _trajectory() -> Figure:
    planner = load_planner("kuka_iiwa14")
    scene = scene_from_shapes([box([0.55, 0.0, 0.75], [0.12, 0.3, 0.22])])
    start, goal = [-0.9, 0.9, 0, -1, 0, 0.6, 0], [0.9, 0.9, 0, -1, 0, 0.6, 0]
    plan = planner.plan(scene, start, goal, trajectory=True)
    assert plan.trajectory is not None
    shown = sample_trajectory(planner.robot, plan.trajectory, 0.002)
    robot = planner.robot
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(shown.times, shown.velocities / robot.velocity_limit)
    left.set(title="velocities, of their limits", xlabel="time [s]", ylim=(-1.1, 1.1))
    right.plot(shown.times, shown.torques / robot.torque_limit, label=robot.joint_names)
    right.set(title="torques, of their limits", xlabel="time [s]", ylim=(-1.1, 1.1))
    figure.legend(loc="outside right center")
    return figure


if __name__ == "__main__":
    run_command(lambda: draw_concepts(parse_arguments(DrawConfig)))
