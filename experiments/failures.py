"""Claim: the learned planner's failures are dead ends, long and swinging paths, and a coarse grid.

    python -m experiments.failures

The paper names these in words, without numbers. Measured here on the test problems, from the same
runs as Figure 5:

- dead ends: roadmaps that hold a path, which the search does not find, or puts off for the next;
- long paths: cost over that of the roadmap's shortest path, for the same problem and roadmap;
- swinging back and forth: consecutive motions that turn by more than 90 degrees;
- the grid: starts and goals that are free, and in collision with the voxels the network sees.

"guided" searches roadmaps of its own, so that dead ends and costs are beside those of others;
"guided_sampled" searches the same ones.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.cases import own_case
from experiments.measure import (
    ExperimentConfig,
    command,
    problem_set,
    run_seed,
    save_results,
    statistics,
)
from experiments.style import COLORS, label
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.errors import run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.files import atomic_write
from gnnjax.paper.occupancy import occupancy_grid
from gnnjax.problems.shards import load_problems
from gnnjax.scene.scene import Scene
from gnnjax.training.weights import load_network

CLAIM = "What fails: dead ends, long paths, swinging back and forth, and a grid that is too coarse."
PLANNERS = ("guided", "guided_sampled", "gnn_paper", "gnn", "gnn_lazy", "distance")
REVERSAL = -1e-6  # cosine of the angle between two motions, below which the path turns back


@dataclasses.dataclass(frozen=True)
class FailuresConfig(ExperimentConfig):
    """Measure the failures that the paper describes."""

    num_nodes: tuple[int, ...] = (200, 1000)
    """Roadmap sizes."""
    num_problems: int = 300
    """Problems of the set."""


def run(config: FailuresConfig) -> None:
    """Measures what is missing and draws the figure."""
    if config.quick:
        config = dataclasses.replace(
            config, num_nodes=(30,), num_problems=3, seeds=config.seeds[:1]
        )
    robot = config.robot or "kuka_iiwa14"
    path = problem_set(config, robot, num_problems=config.num_problems)
    touches = ends_in_voxels(path, robot, config.num_problems)
    grid = {"problems": len(touches), "start_or_goal_in_a_voxel": float(touches.mean())}
    rows = save_results(config, "failures", CLAIM, _rows(config, robot, path, touches), grid=grid)
    draw(rows, config.out / "failures.png")


def _rows(
    config: FailuresConfig, robot: str, path: Path, touches: np.ndarray
) -> Iterator[dict[str, Any]]:
    for num_nodes in config.num_nodes:

        def rows_of(case: EvaluateConfig) -> list[list[dict]]:
            return [run_seed(case, seed, config.runs)["problems"] for seed in config.seeds]

        optimal = rows_of(own_case(path, robot, "prm", num_nodes, config.num_problems))
        for planner in PLANNERS:
            case = own_case(path, robot, planner, num_nodes, config.num_problems)
            measured = failures(rows_of(case), optimal, touches)
            key = {"planner": planner, "num_nodes": num_nodes, "command": command(case)}
            yield key | measured


def failures(
    found: list[list[dict]], optimal: list[list[dict]], touches: np.ndarray
) -> dict[str, Any]:
    """Shares and means of the failures, with intervals.

    Args:
        found: rows of the planner, a list a seed.
        optimal: rows of the roadmap's shortest path, on the same roadmaps.
        touches: `[P]`, whether an end of a problem lies in a voxel.
    """

    def table(rows: list[list[dict]], of: Any) -> np.ndarray:
        return np.array([[of(row) for row in seed] for seed in rows])

    def first(row: dict) -> bool:
        return row["success"] and row["roadmaps"] == 1

    solved, solvable = table(found, first), table(optimal, first)
    costs = [table(rows, lambda row: row["cost"] or np.nan) for rows in (found, optimal)]
    both = solved & solvable
    turns = table(found, lambda row: reversals(np.array(row["path"])))
    valid = table(found, lambda row: row["valid"])
    held = np.where(touches, valid, False)
    return {
        "dead_ends": statistics((~solved).astype(float), solvable),
        "cost_ratio": statistics(costs[0] / costs[1], both),
        "reversals": statistics(turns, solved),
        "swinging": statistics((turns > 0).astype(float), solved),
        "failure_end_in_voxel": statistics((~solved).astype(float), held),
        "failure_ends_clear_of_voxels": statistics((~solved).astype(float), valid & ~held),
    }


def reversals(path: np.ndarray) -> float:
    """How many times a path `[L, D]` turns by more than 90 degrees."""
    if len(path) < 3:
        return 0.0
    motions = np.diff(path, axis=0)
    return float(np.sum(np.einsum("ld,ld->l", motions[:-1], motions[1:]) < REVERSAL))


def ends_in_voxels(path: Path, robot_name: str, num_problems: int) -> np.ndarray:
    """`[P]`: whether start or goal collides with the occupancy grid as if it were the scene."""
    robot = load_robot(robot_name)
    problems = load_problems(path, robot).take(slice(num_problems)).problems
    network = load_network("kuka_iiwa14_paper")
    lower, upper, size = network.workspace_lower, network.workspace_upper, network.grid_size
    voxel = np.subtract(upper, lower) / size
    index = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    centers = (np.array(lower) + voxel * (index + 0.5)).astype(np.float32)
    checker = make_checker(robot, axis_aligned=True)
    grid_of = functools.partial(occupancy_grid, lower=lower, upper=upper, grid_size=size)

    @jax.jit
    def free(scene: Scene, ends: jax.Array) -> jax.Array:
        voxels = Scene(
            jnp.asarray(centers),
            jnp.broadcast_to(jnp.asarray(voxel / 2, jnp.float32), centers.shape),
            jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (len(centers), 1)),
            grid_of(scene).reshape(-1) > 0,
        )
        return checker.check_configurations(voxels, ends)

    touches = []
    for i in range(len(problems.start)):
        problem = jax.tree.map(lambda x, i=i: jnp.asarray(x[i]), problems)
        ends = jnp.stack([problem.start, problem.goal])
        touches.append(not np.asarray(free(problem.scene, ends)).all())
    return np.array(touches)


PANELS = (
    ("dead_ends", "dead ends [% of solvable roadmaps]", 100.0),
    ("cost_ratio", "cost over the shortest path's", 1.0),
    ("swinging", "paths that turn back [%]", 100.0),
)


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draws bars with intervals, a group a roadmap size."""
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    sizes, width = sorted({row["num_nodes"] for row in rows}), 0.8 / len(PLANNERS)
    for column, (name, title, scale) in enumerate(PANELS, start=1):
        axes = figure.add_subplot(1, 3, column)
        for offset, planner in enumerate(PLANNERS):
            chosen = [row for row in rows if row["planner"] == planner and row[name]]
            place = width * (offset - (len(PLANNERS) - 1) / 2)
            at = [sizes.index(row["num_nodes"]) + place for row in chosen]
            mean = np.array([scale * row[name]["mean"] for row in chosen])
            ends = [[scale * row[name][end] for row in chosen] for end in ("low", "high")]
            error = np.maximum([mean - ends[0], ends[1] - mean], 0)
            color = COLORS[planner]
            axes.bar(
                at, mean, 0.9 * width, yerr=error, color=color, label=label(planner), capsize=2
            )
        axes.set_xticks(range(len(sizes)), [f"N = {n}" for n in sizes])
        axes.set_title(title)
        if name == "cost_ratio":
            axes.set_ylim(bottom=0.9)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(FailuresConfig)))
