"""Claim: seeing a few points of the arm tells valid edges from blocked ones for less than a check.

    python -m experiments.predictor

How well motion networks of several sizes tell a roadmap's valid edges from its blocked ones (area
under the ROC curve), over the operations that asking them about an edge takes. The edges are those
of labelled roadmaps of the validation set, whose nodes are valid. Networks look at each edge in
pieces of several largest lengths, without being trained anew.

Operations are those on an edge of 3 rad. What a network sees of the arm (kinematics, distances of
points to boxes), and a configuration check of the fused kernel, are counted in the compiled program
like in `benchmark_collision.py`: sums, products, comparisons, roots, sines and so on, one each. An
edge of n pieces is seen at n + 1 configurations. The network's own are counted by formula for each
piece: two for every weight, and ten for every point's features. A check of the edge tests what is
between its ends every 0.05 rad. Boxes are as many as the scenes have in the mean, rounded.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import nnx
from matplotlib.figure import Figure

from experiments import training
from experiments.benchmark_collision import operations
from experiments.measure import ExperimentConfig, save_results
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.checker import EDGE_RESOLUTION, make_checker
from gnnjax.errors import run_command
from gnnjax.files import atomic_write
from gnnjax.guide.motion import MotionNetwork, make_prices
from gnnjax.guide.view import arm_view
from gnnjax.problems.labelled import LabelledRoadmap, generate_labelled, problem_keys
from gnnjax.scene.scene import Scene
from gnnjax.train_motion import TrainMotionConfig, area_under_curve
from gnnjax.training.weights import load_network

CLAIM = "A few points of the arm tell valid edges from blocked ones for less than a check costs."
EDGE_LENGTH = 3.0  # rad, of the edge that operations are counted for
_BATCH = 1024  # configurations of the programs in which operations are counted


@dataclasses.dataclass(frozen=True)
class PredictorConfig(ExperimentConfig):
    """Motion networks of several sizes: how well they tell edges, and what that takes."""

    robots: tuple[str, ...] = ("kuka_iiwa14", "kinova_gen3")
    """Arms whose edges are told apart, and which the networks are trained on."""
    num_points: tuple[int, ...] = (6, 12)
    """Points of the arm that are looked at."""
    channels: tuple[int, ...] = (16,)
    """Widths of the networks."""
    spacings: tuple[float, ...] = (1.5, 0.8, 0.5, 0.35)
    """Largest lengths of the pieces, rad."""
    steps: int = 300
    """Of each training."""
    num_roadmaps: int = 40
    """Labelled roadmaps of each arm."""
    num_nodes: int = 200
    """Of the roadmaps."""
    trained: Path = Path("runs/predictor")
    """Where the networks go."""


@dataclasses.dataclass(frozen=True)
class Edges:
    """Labelled edges of R roadmaps of an arm, padded to E each."""

    robot: Robot
    scenes: Scene  # [R ...]
    starts: np.ndarray  # [R E D]
    ends: np.ndarray  # [R E D]
    valid: np.ndarray  # [R E]
    mask: np.ndarray  # [R E] false on padding

    @property
    def lengths(self) -> np.ndarray:
        """`[R E]`, configuration units."""
        return np.linalg.norm(self.ends - self.starts, axis=-1)

    @property
    def num_boxes(self) -> int:
        """Boxes of a scene in the mean, rounded."""
        return max(1, round(float(self.scenes.mask.sum(axis=-1).mean())))


def run(config: PredictorConfig) -> None:
    """Trains what is missing, tells edges apart and draws the figure."""
    if config.quick:
        config = dataclasses.replace(
            config,
            robots=(config.robot or config.robots[0],),
            num_points=config.num_points[:1],
            channels=config.channels[:1],
            spacings=config.spacings[:2],
            steps=2,
            num_roadmaps=2,
            num_nodes=30,
        )
    sets = [labelled_edges(name, config) for name in config.robots]
    checks = {edges.robot.name: check_operations(edges) for edges in sets}
    rows = save_results(
        config,
        "predictor",
        CLAIM,
        _rows(config, sets),
        check_operations=checks,
        edge_length=EDGE_LENGTH,
        resolution=EDGE_RESOLUTION,
    )
    draw(rows, checks, config.out / "predictor.png")


def _rows(config: PredictorConfig, sets: list[Edges]) -> Iterator[dict[str, Any]]:
    for name, command, network in _networks(config):
        areas = [areas_under_curve(network, edges, config.spacings) for edges in sets]
        seen = [view_operations(edges, network.num_points) for edges in sets]
        for number, spacing in enumerate(config.spacings):
            row = {"network": name, "spacing": spacing, "command": command}
            row |= {"num_points": network.num_points, "channels": network.channels}
            pieces = math.ceil(EDGE_LENGTH / spacing)
            each = network_operations(network)
            row["arms"] = {
                edges.robot.name: {
                    "area": area[number],
                    "operations": (pieces + 1) * view + pieces * each,
                    "num_edges": int(edges.mask.sum()),
                    "share_valid": float(edges.valid[edges.mask].mean()),
                }
                for edges, area, view in zip(sets, areas, seen, strict=True)
            }
            yield row


def _networks(config: PredictorConfig) -> Iterator[tuple[str, str, MotionNetwork]]:
    """Names, commands of the trainings, and networks: those of all sizes, then the shipped one."""
    for points, channels in itertools.product(config.num_points, config.channels):
        arms = "-".join(Path(robot).stem for robot in config.robots)
        made = TrainMotionConfig(
            robots=config.robots,
            out=config.trained / f"{arms}_{points}_{channels}_{config.steps}",
            steps=config.steps,
            num_points=points,
            channels=channels,
            **({"scenes": 2, "motions": 16} if config.quick else {}),
        )
        network = load_network(training.trained(made))
        assert isinstance(network, MotionNetwork)
        name = f"{points} points, {channels} wide, {config.steps} steps"
        yield name, training.command(made), network
    network = load_network("motion")
    assert isinstance(network, MotionNetwork)
    yield "shipped", "python -m gnnjax.train_motion", network


def labelled_edges(robot_name: str, config: PredictorConfig) -> Edges:
    """The edges of validation roadmaps, each once."""
    robot = load_robot(robot_name)
    draw = generate_labelled(robot, config.num_nodes)
    drawn = draw(problem_keys(0, "validation", 0, config.num_roadmaps))
    assert isinstance(drawn, LabelledRoadmap)
    roadmaps, labels = jax.tree.map(np.asarray, (drawn.roadmap, drawn.labels))
    own = np.arange(roadmaps.nodes.shape[1])[:, None]
    once = roadmaps.neighbor_mask & (own < roadmaps.neighbors)
    most = int(once.sum(axis=(1, 2)).max())
    shape = (config.num_roadmaps, most)
    starts, ends = np.zeros((2, *shape, robot.num_dof), np.float32)
    valid, mask = np.zeros((2, *shape), bool)
    for i, chosen in enumerate(once):
        node, slot = np.nonzero(chosen)
        num = len(node)
        starts[i, :num] = roadmaps.nodes[i, node]
        ends[i, :num] = roadmaps.nodes[i, roadmaps.neighbors[i, node, slot]]
        valid[i, :num] = labels.edge_valid[i, node, slot]
        mask[i, :num] = True
    scenes = jax.tree.map(np.asarray, drawn.problem.scene)
    return Edges(robot, scenes, starts, ends, valid, mask)


def areas_under_curve(
    network: MotionNetwork, edges: Edges, spacings: tuple[float, ...]
) -> list[float]:
    """How well a network tells valid edges from blocked ones, for each spacing."""
    view = arm_view(edges.robot, network.num_points)
    graphdef, weights = nnx.split(network)
    most = math.ceil(float(edges.lengths.max()) / min(spacings))

    @jax.jit
    def scores(weights: Any, scene: Scene, starts: jax.Array, ends: jax.Array, spacing: jax.Array):
        seen = functools.partial(view, scene)
        prices = make_prices(nnx.merge(graphdef, weights), seen, spacing)
        return -prices.motions(starts, ends, most)

    areas = []
    for spacing in spacings:
        found = [
            scores(weights, jax.tree.map(lambda x, i=i: x[i], edges.scenes), *ends, spacing)
            for i, ends in enumerate(zip(edges.starts, edges.ends, strict=True))
        ]
        areas.append(area_under_curve(np.stack(found)[edges.mask], edges.valid[edges.mask]))
    return areas


def _counted(edges: Edges, function: Callable) -> int:
    """Operations of a compiled function `(scene, q [B D])`, for a configuration."""
    scene = jax.tree.map(lambda x: jnp.asarray(x[0]), edges.scenes)
    q = jnp.zeros((_BATCH, edges.robot.num_dof))
    program = jax.jit(function).lower(scene, q).compile().as_text()
    assert program is not None
    return operations(program, _BATCH, edges.num_boxes).total()


def view_operations(edges: Edges, num_points: int) -> int:
    """Operations of what a network sees of the arm at a configuration."""
    return _counted(edges, arm_view(edges.robot, num_points))


def check_operations(edges: Edges) -> int:
    """Operations of checking a free edge between its ends with the fused kernel."""
    checker = make_checker(edges.robot, axis_aligned=True)
    between = math.ceil(EDGE_LENGTH / EDGE_RESOLUTION) - 1
    return between * _counted(edges, checker.check_configurations)


def network_operations(network: MotionNetwork) -> int:
    """Operations of the network itself for a piece of a motion, by formula."""
    weights = sum(x.size for x in jax.tree.leaves(nnx.state(network, nnx.Param)))
    return 2 * weights + 10 * (network.num_points + 1)


def draw(rows: list[dict[str, Any]], checks: dict[str, int], out: Path) -> None:
    """Draws the area over operations, a panel an arm and a line a network; grey: the best."""
    figure = Figure(figsize=(6.5 * len(checks), 4.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(checks)))
    for axes, (arm, check) in zip(panels, checks.items(), strict=True):
        points = [(row["arms"][arm]["operations"], row["arms"][arm]["area"]) for row in rows]
        for name in dict.fromkeys(row["network"] for row in rows):
            line = [p for p, row in zip(points, rows, strict=True) if row["network"] == name]
            style = {"color": "black", "lw": 2} if name == "shipped" else {"lw": 1}
            axes.plot(*zip(*sorted(line), strict=True), ".-", label=name, **style)
        front = pareto(points)
        axes.step(*zip(*front, strict=True), where="post", color="0.7", lw=5, zorder=0)
        axes.axvline(check, color="black", ls=":")
        axes.annotate(
            "checking the edge", (check, 0.02), xycoords=("data", "axes fraction"), rotation=90
        )
        axes.set(xscale="log", title=arm, xlabel=f"operations for an edge of {EDGE_LENGTH:g} rad")
    panels[0].set_ylabel("area under the ROC curve")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


def pareto(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points `(cost, gain)` that gain more than all that cost no more, by cost."""
    front: list[tuple[float, float]] = []
    for cost, gain in sorted(points, key=lambda point: (point[0], -point[1])):
        if not front or gain > front[-1][1]:
            front.append((cost, gain))
    return front


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(PredictorConfig)))
