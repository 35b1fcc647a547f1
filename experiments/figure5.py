"""Claim: a learned guide finds paths with fewer collision checks than PRM, RRT* and BIT* (R^7).

    python -m experiments.figure5

The paper's Figure 5 on the KUKA iiwa 14: roadmaps of 200 to 1000 nodes, 300 test problems of its
distribution. Beside its planners stand the default planner, as it is and with parts left out, and
those that the paper leaves out: RRT-Connect, LazySP, and a greedy walk by the distance to the goal.
The same is measured on the first 300 public problems, if `data/kuka_iiwa14_public.npz` is there
(`python -m experiments.convert_public` makes it).

How near checks come to those of the returned path alone is measured for the planners of `BOUNDED`,
see `bounds.py`.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.bounds import first_roadmap, per_verification
from experiments.cases import CLASSICAL, GUIDED, OURS, classical_case, own_case
from experiments.measure import ExperimentConfig, measure, problem_sets, run_seed, save_results
from experiments.style import BAND, COLORS, label
from gnnjax.errors import run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.files import atomic_write

CLAIM = "A learned guide finds paths with fewer collision checks than PRM, RRT* and BIT* in R^7."

PLANNERS = tuple(dict.fromkeys((*GUIDED, *OURS, "gnn_paper")))
# On the same roadmaps: how many edges they check for each edge of the path.
BOUNDED = ("guided_sampled", "gnn_lazy", "lazysp", "gnn", "distance", "oracle")

# What the paper states of its Figure 5 in words, over all roadmap sizes.
PAPER = {
    "gnn": {"success": 0.98, "cost": 19.452, "total_time_s": 1.63, "planning_time_s": 0.193},
    "prm": {"success": 0.97, "cost": 13.473, "total_time_s": 20.47, "planning_time_s": 12.02},
    "ompl:bit_star": {"success": 0.97, "cost": 12.271},
    "ompl:rrt_star": {"success": 0.98, "cost": 16.010},
}
# Edge checks of the paper's planner as shares of those of others.
PAPER_SHARES = {"prm": 0.0049, "ompl:bit_star": 0.9443, "ompl:rrt_star": 0.0174}


@dataclasses.dataclass(frozen=True)
class Figure5Config(ExperimentConfig):
    """All planners on the Kuka's problems, over roadmap sizes."""

    num_nodes: tuple[int, ...] = (200, 400, 600, 800, 1000)
    """Roadmap sizes."""
    num_problems: int = 300
    """Problems of each set."""
    guided_num_nodes: tuple[int, ...] = (200, 1000)
    """Roadmap sizes of the default planner, and of the comparison of searches."""
    fine_num_nodes: tuple[int, ...] = (200,)
    """Roadmap sizes of the default planner with edges tested every 0.02 rad."""


def run(config: Figure5Config) -> None:
    """Measures what is missing and draws the figure."""
    if config.quick:
        config = dataclasses.replace(
            config,
            num_nodes=(30,),
            num_problems=3,
            seeds=config.seeds[:1],
            guided_num_nodes=(30,),
            fine_num_nodes=(),
        )
    rows = save_results(config, "figure5", CLAIM, _rows(config), paper=PAPER)
    draw([row for row in rows if row["set"] == "test"], config.out / "figure5.png")


def _rows(config: Figure5Config) -> Iterator[dict[str, Any]]:
    robot = config.robot or "kuka_iiwa14"
    num = config.num_problems
    sets = problem_sets(config, robot, num)
    for num_nodes in config.num_nodes:
        varied = num_nodes in config.guided_num_nodes
        for planner in PLANNERS:
            if planner in GUIDED and not varied:
                continue
            if planner == "guided_roadmap" and num_nodes != config.guided_num_nodes[0]:
                continue
            for name, path in sets.items():
                case = own_case(path, robot, planner, num_nodes, num)
                row = {"set": name, "planner": planner, "num_nodes": num_nodes}
                row |= _measured(config, case)
                if planner in BOUNDED and varied:
                    compared = (
                        _problems(config, own_case(path, robot, p, num_nodes, num))
                        for p in (planner, "guided_sampled", "lazysp", "prm")
                    )
                    row["first_roadmap"] = first_roadmap(*compared)
                yield row
    for planner in (*CLASSICAL, "ompl:rrt_connect@simplified", "ompl:rrt_connect@0.02"):
        for name, path in sets.items():
            if planner == "ompl:rrt_connect@simplified" and name != "test":
                continue
            case = classical_case(path, robot, planner, num)
            key = {"set": name, "planner": planner, "num_nodes": None}
            yield key | _measured(config, case)
    # At the resolution of an earlier measurement with PyBullet, to compare.
    for num_nodes in config.fine_num_nodes:
        for name, path in sets.items():
            if name != "public":
                continue
            case = own_case(path, robot, "guided@0.02", num_nodes, num)
            key = {"set": name, "planner": "guided@0.02", "num_nodes": num_nodes}
            yield key | _measured(config, case)


def _measured(config: Figure5Config, case: EvaluateConfig) -> dict[str, Any]:
    """What every planner is measured by."""
    measured = measure(case, config.seeds, config.runs)
    ratio = per_verification(_problems(config, case), case.resolution)
    return measured | {"per_verification": ratio}


def _problems(config: Figure5Config, case: EvaluateConfig) -> list[list[dict]]:
    return [run_seed(case, seed, config.runs)["problems"] for seed in config.seeds]


PANELS = (
    ("edge_checks", "edge checks", 1.0, True),
    ("configuration_checks", "configuration checks", 1.0, True),
    ("total_time_s", "total time [ms]", 1e3, True),
    ("planning_time_s", "planning time [ms]", 1e3, True),
    ("cost", "path cost [rad]", 1.0, False),
    ("success", "solved [%]", 100.0, False),
)


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draws means over N with their 95 % intervals; the paper's own numbers are dotted."""
    figure = Figure(figsize=(13, 7.2), layout="constrained")
    for index, (name, title, scale, logarithmic) in enumerate(PANELS, start=1):
        axes = figure.add_subplot(2, 3, index)
        sizes = sorted({row["num_nodes"] for row in rows if row["num_nodes"]})
        for planner in COLORS:
            chosen = [row for row in rows if row["planner"] == planner]
            points = [(row["num_nodes"], row["summary"]["all"][name]) for row in chosen]
            points = [(n, value) for n, value in points if value is not None]
            if not points:
                continue
            if points[0][0] is None:  # a planner that grows its own graph
                points = [(n, points[0][1]) for n in (sizes[0], sizes[-1])]
            at, values = zip(*sorted(points, key=lambda point: point[0]), strict=True)
            mean, low, high = (scale * np.array([v[k] for v in values]) for k in BAND)
            style = "--" if planner.startswith("ompl:") else "-"
            axes.plot(at, mean, style, color=COLORS[planner], label=label(planner))
            axes.fill_between(at, low, high, color=COLORS[planner], alpha=0.15, linewidth=0)
        for planner, values in PAPER.items():
            if name in values:
                axes.axhline(scale * values[name], color=COLORS[planner], linestyle=":", lw=1)
        axes.set(title=title, xlabel="nodes of the roadmap")
        axes.set_xticks(sizes)
        if logarithmic:
            axes.set_yscale("log")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6)
    figure.suptitle("Means with 95 % intervals; dashed: OMPL; dotted: the paper's own numbers")
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(Figure5Config)))
