"""Claim: the learned planner's failures are dead ends, long and swinging paths, and a coarse grid.

    python -m experiments.failures

The paper names these in words, without numbers. Measured here on the test problems, from the same
runs as Figure 5:

- dead ends: roadmaps that hold a path, which the search does not find, or puts off for the next;
- long paths: cost over that of the roadmap's shortest path, for the same problem and roadmap;
- swinging back and forth: consecutive motions that turn by more than 90 degrees;
- the grid: starts and goals that are free, and in collision with the voxels the network sees.

"guided_sampled" searches the same roadmaps as the others. "guided_dear", told that checks are dear,
searches roadmaps of its own; "guided" searches none, but grows trees from start and goal, and what
these do not solve counts as its dead ends. Of both, dead ends and costs are set beside the others'
roadmaps all the same, whose paths are not shortened as theirs are.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.cases import own_case
from experiments.measure import ExperimentConfig, command, measure_problems, problem_set
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.statistics import Rows, column, solved_first, statistics
from experiments.style import draw_bars, label
from experiments.tables import interval, markdown, span
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.paper.occupancy import occupancy_grid
from gnnjax.problems.shards import load_problems
from gnnjax.scene.scene import Scene, box_scene
from gnnjax.training.weights import load_network

PLANNERS = ("guided", "guided_dear", "guided_sampled", "gnn_paper", "gnn", "gnn_lazy", "distance")
REVERSAL = -1e-6  # cosine of the angle between two motions, below which the path turns back


@dataclasses.dataclass(frozen=True)
class FailuresConfig(ExperimentConfig):
    """Measure the failures that the paper describes."""

    num_nodes: tuple[int, ...] = (200, 1000)
    """Roadmap sizes."""
    num_problems: int = 300
    """Problems of the set."""


def measurement(config: FailuresConfig) -> Measurement:
    """Rows of planners by roadmap size, and how often the grid is in the way."""
    robot = config.robot or "kuka_iiwa14"
    path = problem_set(config, robot, num_problems=config.num_problems)
    touches = ends_in_voxels(path, robot, config.num_problems)
    grid = {"problems": len(touches), "start_or_goal_in_a_voxel": float(touches.mean())}
    return Measurement(_rows(config, robot, path, touches), {"grid": grid})


def _rows(config: FailuresConfig, robot: str, path: Path, touches: np.ndarray) -> Iterator[Row]:
    for num_nodes in config.num_nodes:
        best = own_case(path, robot, "prm", num_nodes, config.num_problems)
        optimal = measure_problems(config, best)
        for planner in PLANNERS:
            case = own_case(path, robot, planner, num_nodes, config.num_problems)
            measured = failures(measure_problems(config, case), optimal, touches)
            key = {"planner": planner, "num_nodes": num_nodes, "command": command(case)}
            yield key | measured


def failures(found: Rows, optimal: Rows, touches: np.ndarray) -> Row:
    """Shares and means of the failures, with intervals.

    Args:
        found: rows of the planner.
        optimal: rows of the roadmap's shortest path, on the same roadmaps.
        touches: `[P]`, whether an end of a problem lies in a voxel.
    """
    solved, solvable = (column(rows, solved_first).astype(bool) for rows in (found, optimal))
    costs = [column(rows, lambda row: row["cost"]) for rows in (found, optimal)]
    turns = column(found, lambda row: reversals(np.array(row["path"])))
    valid = column(found, lambda row: row["valid"]).astype(bool)
    held = np.where(touches, valid, False)
    return {
        "dead_ends": statistics((~solved).astype(float), solvable),
        "cost_ratio": statistics(costs[0] / costs[1], solved & solvable),
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
        voxels = box_scene(
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


def draw(results: Row) -> Figure:
    """Draws bars with intervals, a group a roadmap size."""
    rows = results["rows"]
    figure = Figure(figsize=(12, 3.6), dpi=110, layout="constrained")
    found = {(row["planner"], row["num_nodes"]): row for row in rows}
    sizes = sorted({size for _, size in found})
    planners = [planner for planner in PLANNERS if (planner, sizes[0]) in found]
    for place, (name, title, scale) in enumerate(PANELS, start=1):
        axes = figure.add_subplot(1, 3, place)
        values = {planner: [found[planner, n][name] for n in sizes] for planner in planners}
        draw_bars(axes, values, [f"N = {n}" for n in sizes], scale)
        axes.set_title(title)
        if name == "cost_ratio":
            axes.set_ylim(bottom=0.9)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def table(results: Row) -> str:
    """Dead ends, cost and swinging of each planner."""
    columns = (
        ("dead ends, %", "dead_ends", ".1f", 100.0),
        ("cost over the shortest path's", "cost_ratio", ".3f", 1.0),
        ("paths that turn back, %", "swinging", ".1f", 100.0),
        ("turns of more than 90 degrees a path", "reversals", ".2f", 1.0),
        ("failed where an end lies in a voxel, %", "failure_end_in_voxel", ".1f", 100.0),
        ("failed elsewhere, %", "failure_ends_clear_of_voxels", ".1f", 100.0),
    )
    lines = [
        [str(row["num_nodes"]), label(row["planner"])]
        + [interval(row[name], form, scale) for _, name, form, scale in columns]
        for row in results["rows"]
    ]
    share = 100 * results["grid"]["start_or_goal_in_a_voxel"]
    note = (
        "Start or goal, free in the scene, collides with the voxels of the occupancy grid in "
        f"{share:.0f} % of the problems.\n"
    )
    return markdown(["N", "planner", *[title for title, *_ in columns]], lines) + "\n" + note


def verdict(results: Row) -> str:
    """Whether the paper's planner fails in each of these ways at every roadmap size. The grid is
    to blame only where it fails more often than a walk that sees no grid."""

    def each(planner: str, name: str, key: str = "mean") -> list[float]:
        rows = [row for row in results["rows"] if row["planner"] == planner]
        return [math.nan if row[name] is None else row[name][key] for row in rows]

    def percent(planner: str, name: str) -> str:
        return span(each(planner, name), ".1f", 100) + " %"

    paper, walk, lazy = "gnn_paper", "distance", "gnn_lazy"
    inside, clear = "failure_end_in_voxel", "failure_ends_clear_of_voxels"
    blamed = [
        least > max(elsewhere, without)
        for least, elsewhere, without in zip(
            each(paper, inside, "low"), each(paper, clear), each(walk, inside), strict=True
        )
    ]
    cost = span(each(paper, "cost_ratio"), ".2f")
    grid = (
        f"where an end lies in a voxel {percent(paper, inside)} fail, elsewhere "
        f"{percent(paper, clear)}, but with the distance to the goal, which sees no grid, "
        f"{percent(walk, inside)} and {percent(walk, clear)}"
    )
    return judge(
        Finding(
            min(each(paper, "dead_ends", "low")) > 0,
            f"dead ends in {percent(paper, 'dead_ends')} of the roadmaps that hold a path",
        ),
        Finding(min(each(paper, "cost_ratio", "low")) > 1, f"{cost} times the shortest path"),
        Finding(
            min(each(paper, "swinging", "low")) > max(each(lazy, "swinging", "high")),
            f"{percent(paper, 'swinging')} of the paths turn back ({label(lazy)}: "
            f"{percent(lazy, 'swinging')})",
        ),
        Finding(all(blamed), grid),
        beside=[
            f"{name}: dead ends {percent(planner, 'dead_ends')}, "
            f"{span(each(planner, 'cost_ratio'), '.2f')} times the shortest path, "
            f"{percent(planner, 'swinging')} turn back."
            for planner, name in ((walk, "Without any network"), (lazy, "With a lazy search"))
        ],
    )


EXPERIMENT = Experiment(
    name="failures",
    title="How the paper's planner fails",
    claim=(
        "What fails: dead ends, long paths, swinging back and forth, and a grid that is too coarse."
    ),
    config=FailuresConfig,
    quick={"num_nodes": (30,), "num_problems": 3},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
