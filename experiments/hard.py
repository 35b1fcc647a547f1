"""Claim: the harder the problem, the more the guide saves; and where it stops being of use.

    python -m experiments.hard

The problems of Figure 5 in strata, from the same runs (N = 1000): the straight line from start to
goal free or blocked; how many boxes; and how narrow the way is, which is the least clearance of
the arm along the roadmap's shortest path (PRM's, first seed, seen every 0.05 rad). Less than 1 cm
counts as a narrow passage. Then 50 problems of each family of hard scenes
(`gnnjax.problems.families`): thin walls, shelves, many boxes, turned anyhow. The guidance network
never saw these; the motion network was trained on scenes of these kinds, though on none of these.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.cases import classical_case, own_case
from experiments.measure import (
    ExperimentConfig,
    command,
    measure,
    problem_set,
    problem_sets,
    run_seed,
    save_results,
    summarize_seeds,
)
from experiments.style import draw_bars
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import path_clearance
from gnnjax.collision.checker import EDGE_RESOLUTION
from gnnjax.errors import run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.files import atomic_write
from gnnjax.problems.families import FAMILIES
from gnnjax.problems.shards import load_problems

CLAIM = "The harder the problem, the more the guide saves."
PLANNERS = (
    *("guided", "gnn", "gnn_lazy", "distance", "lazysp", "oracle", "prm"),
    *("ompl:rrt_connect", "ompl:bit_star"),
)
FAMILY_PLANNERS = (
    "guided",
    *("gnn", "gnn_lazy", "distance", "lazysp", "ompl:rrt_connect", "ompl:bit_star"),
)

# Upper ends of the strata: boxes, and clearance in m.
BOXES = {"2-3 boxes": 3, "4-5 boxes": 5, "6-7 boxes": 7, "8-9 boxes": 9}
CLEARANCES = {"< 1 cm": 0.01, "1-3 cm": 0.03, "3-6 cm": 0.06, "> 6 cm": np.inf}


@dataclasses.dataclass(frozen=True)
class HardConfig(ExperimentConfig):
    """Strata of the problems by how hard they are, and families of hard scenes."""

    num_nodes: int = 1000
    """Nodes of a roadmap."""
    num_problems: int = 300
    """Problems of each set of Figure 5."""
    families: tuple[str, ...] = tuple(FAMILIES)
    """Families of scenes."""
    family_problems: int = 50
    """Problems of each family."""
    family_planners: tuple[str, ...] = FAMILY_PLANNERS
    """Planners for the families."""
    guided_sizes: tuple[int, ...] = (1000,)
    """Roadmap sizes of the guided planner on the families."""


def run(config: HardConfig) -> None:
    """Measures what is missing and draws the figure."""
    if config.quick:
        config = dataclasses.replace(
            config,
            num_nodes=30,
            num_problems=3,
            seeds=config.seeds[:1],
            families=config.families[-1:],
            family_problems=2,
            # Scenes of their own kind are compiled anew for each planner.
            family_planners=("guided", "ompl:rrt_connect"),
            guided_sizes=(30,),
        )
    robot = config.robot or "kuka_iiwa14"
    rows = save_results(config, "hard", CLAIM, _rows(config, robot))
    drawn = [row for row in rows if row["num_nodes"] in (None, config.num_nodes)]
    draw(drawn, config.out / "hard.png")


def _rows(config: HardConfig, robot: str) -> Iterator[dict[str, Any]]:
    for name, path in problem_sets(config, robot, config.num_problems).items():
        yield from _strata_rows(config, robot, name, path)
    for family in config.families:
        path = problem_set(config, robot, family=family, num_problems=config.family_problems)
        for planner in config.family_planners:
            guided = planner.startswith("guided")
            for size in config.guided_sizes if guided else (config.num_nodes,):
                sized = dataclasses.replace(config, num_nodes=size)
                case = _case(sized, path, robot, planner, config.family_problems)
                key = {"set": family, "stratum": family, "planner": planner}
                yield key | {"num_nodes": _size(case)} | measure(case, config.seeds, config.runs)


def _strata_rows(config: HardConfig, robot: str, name: str, path: Path) -> Iterator[dict[str, Any]]:
    def rows_of(planner: str) -> tuple[EvaluateConfig, list[list[dict]]]:
        case = _case(config, path, robot, planner, config.num_problems)
        return case, [run_seed(case, seed, config.runs)["problems"] for seed in config.seeds]

    chosen = strata(robot, path, rows_of("prm")[1][0])
    for planner in PLANNERS:
        case, per_seed = rows_of(planner)
        for stratum, members in chosen.items():
            yield {
                "set": name,
                "stratum": stratum,
                "planner": planner,
                "num_nodes": _size(case),
                "command": command(case),
                "summary": summarize_seeds(per_seed, keep=lambda index, m=members: bool(m[index])),
            }


def _case(config: HardConfig, path: Path, robot: str, planner: str, num: int) -> EvaluateConfig:
    if planner.startswith("ompl:"):
        return classical_case(path, robot, planner, num)
    return own_case(path, robot, planner, config.num_nodes, num)


def _size(case: EvaluateConfig) -> int | None:
    return None if case.planner.startswith("ompl:") else case.num_nodes


def strata(robot_name: str, path: Path, rows: list[dict]) -> dict[str, np.ndarray]:
    """Which problems belong to which stratum, `[P]` each.

    Args:
        robot_name: of the arm, or path of an MJCF.
        path: of the problem set.
        rows: results of PRM on its first P problems, for the narrowness of the way. Problems that
            it does not solve are a stratum of their own.
    """
    robot = load_robot(robot_name)
    problems = load_problems(path, robot).take(slice(len(rows))).problems
    hard = np.array([row["hard"] for row in rows])
    boxes = problems.scene.mask.sum(axis=1)
    clearances = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        if row["success"]:
            scene = jax.tree.map(lambda x, i=i: x[i], problems.scene)
            clearances[i] = path_clearance(robot, scene, np.array(row["path"]), EDGE_RESOLUTION)
    return {
        "line free": ~hard,
        "line blocked": hard,
        **_between(boxes, BOXES),
        **_between(clearances, CLEARANCES),
        "no path in\nPRM's roadmaps": np.isnan(clearances),
    }


def _between(values: np.ndarray, upper: dict[str, float]) -> dict[str, np.ndarray]:
    """Splits values at upper ends, each of which belongs to its stratum; NaN is in none."""
    low, split = -np.inf, {}
    for name, high in upper.items():
        split[name] = (values > low) & (values <= high)
        low = high
    return split


PANELS = (
    ("success", "solved [%]", 100.0),
    ("configuration_checks", "configuration checks, mean", 1.0),
)


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draws bars with intervals: a row of panels for the test set, the public one, and families."""
    kinds = {name: [row for row in rows if row["set"] == name] for name in ("test", "public")}
    kinds["families"] = [row for row in rows if row["set"] not in kinds]
    kinds = {name: chosen for name, chosen in kinds.items() if chosen}
    figure = Figure(figsize=(20, 3.6 * len(kinds) + 0.8), layout="constrained")
    panels = np.atleast_2d(figure.subplots(len(kinds), 2))
    for (kind, chosen), line in zip(kinds.items(), panels, strict=True):
        counts = {row["stratum"]: row["summary"]["all"]["num_problems"] for row in chosen}
        groups = [stratum for stratum, count in counts.items() if count]
        planners = [p for p in PLANNERS if any(row["planner"] == p for row in chosen)]
        found = {(row["planner"], row["stratum"]): row["summary"]["all"] for row in chosen}
        names = [f"{group}\n({counts[group]})" for group in groups]
        for (quantity, title, scale), axes in zip(PANELS, line, strict=True):
            values = {p: [found[p, group][quantity] for group in groups] for p in planners}
            draw_bars(axes, values, names, scale)
            axes.set_title(f"{kind}: {title}")
            axes.tick_params(axis="x", labelsize=8)
            if quantity != "success":
                axes.set_yscale("log")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=8)
    figure.suptitle("Means with 95 % intervals; in brackets: problems of the stratum")
    atomic_write(out, lambda file: figure.savefig(file, dpi=100))


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(HardConfig)))
