"""Claim: a guide finds paths with fewer collision checks than PRM, RRT* and BIT* (R^7).

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
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.bounds import (
    BOUNDED,
    BOUNDS_NOTE,
    VERIFICATION_NOTE,
    bounds_table,
    first_roadmap,
    per_verification,
    verification_table,
)
from experiments.cases import CLASSICAL, GUIDED, OURS, classical_case, nodes_of, own_case
from experiments.measure import ExperimentConfig, measure, measure_problems, problem_sets
from experiments.published import FIGURE5
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Measured, Row, of_set
from experiments.statistics import BAND
from experiments.style import COLORS, label, make_logarithmic
from experiments.tables import (
    DETAIL,
    MAIN,
    SETS,
    cell,
    listing,
    markdown,
    measured_on,
    planner_table,
    span,
)
from gnnjax.evaluate import EvaluateConfig

PLANNERS = tuple(dict.fromkeys((*GUIDED, *OURS, "gnn_paper")))


@dataclasses.dataclass(frozen=True)
class Figure5Config(ExperimentConfig):
    """All planners on the Kuka's problems, over roadmap sizes."""

    num_nodes: tuple[int, ...] = (200, 400, 600, 800, 1000)
    """Roadmap sizes."""
    num_problems: int = 300
    """Problems of each set."""
    guided_num_nodes: tuple[int, ...] = (200, 1000)
    """Roadmap sizes of the comparison of searches; the first is that of the default planner where
    it searches roadmaps."""


def measurement(config: Figure5Config) -> Measurement:
    """Rows of planners on problem sets, by roadmap size."""
    return Measurement(_rows(config), {"paper": FIGURE5})


def _rows(config: Figure5Config) -> Iterator[Row]:
    robot = config.robot or "kuka_iiwa14"
    num = config.num_problems
    sets = problem_sets(config, robot, num)
    for num_nodes in config.num_nodes:
        varied = num_nodes in config.guided_num_nodes
        for planner in PLANNERS:
            if planner in GUIDED and not varied:
                continue
            once = planner in ("guided", "guided_dear", "guided_roadmap")
            if once and num_nodes != config.guided_num_nodes[0]:
                continue
            for name, path in sets.items():
                case = own_case(path, robot, planner, num_nodes, num)
                row = {"set": name, "planner": planner, "num_nodes": nodes_of(case)}
                row |= _measured(config, case)
                if planner in BOUNDED and varied:
                    compared = (
                        measure_problems(config, own_case(path, robot, p, num_nodes, num))
                        for p in (planner, "guided_sampled", "lazysp", "prm")
                    )
                    row["first_roadmap"] = first_roadmap(*compared)
                yield row
    only = {"ompl:rrt_connect@simplified": "test", "guided@0.02": "public"}
    for planner in (*CLASSICAL, *only, "ompl:rrt_connect@0.02"):
        for name, path in sets.items():
            if only.get(planner, name) == name:
                case = classical_case(path, robot, planner, num)
                key = {"set": name, "planner": planner, "num_nodes": None}
                yield key | _measured(config, case)


def _measured(config: Figure5Config, case: EvaluateConfig) -> dict[str, Any]:
    """What every planner is measured by."""
    ratio = per_verification(measure_problems(config, case), case.resolution)
    return measure(config, case) | {"per_verification": ratio}


PANELS = (
    ("edge_checks", "edge checks", 1.0, True),
    ("configuration_checks", "configuration checks", 1.0, True),
    ("total_time_s", "total time [ms]", 1e3, True),
    ("planning_time_s", "planning time [ms]", 1e3, True),
    ("cost", "path cost [rad]", 1.0, False),
    ("success", "solved [%]", 100.0, False),
)


def draw(results: Row) -> Figure:
    """Draws means over N with their 95 % intervals; the paper's own numbers are dotted."""
    rows = of_set(results, "test")
    figure = Figure(figsize=(13, 7.2), dpi=110, layout="constrained")
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
        for planner, values in results["paper"].items():
            if name in values:
                axes.axhline(scale * values[name], color=COLORS[planner], linestyle=":", lw=1)
        axes.set(title=title, xlabel="nodes of the roadmap")
        axes.set_xticks(sizes)
        if logarithmic:
            make_logarithmic(axes)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6)
    figure.suptitle("Means with 95 % intervals; dashed: OMPL; dotted: the paper's own numbers")
    return figure


def table(results: Row) -> str:
    """Planners as they are seen, with intervals, and beside the checks of their paths alone."""
    parts = []
    for name, title in SETS.items():
        rows = of_set(results, name)
        if not rows:
            continue
        parts += [f"### {title}\n", measured_on(results, rows[0]) + "\n"]
        parts += ["#### As planners are seen\n", planner_table(rows, MAIN)]
        parts += ["#### With intervals\n", planner_table(rows, DETAIL)]
        parts += ["#### Edge checks per edge of the path\n", BOUNDS_NOTE, bounds_table(rows)]
        parts += ["#### Configuration checks over those of the path alone\n"]
        parts += [VERIFICATION_NOTE, verification_table(rows)]
    fine = resolution_table(of_set(results, "public"))
    return "\n".join([*parts, *(["### By the resolution of edges\n", fine] if fine else [])])


def resolution_table(rows: list[Row]) -> str:
    """Planners that were measured at two resolutions, one beside the other; empty without any."""
    lines = []
    for fine in rows:
        if not fine["planner"].endswith("@0.02"):
            continue
        planner, size = fine["planner"].removesuffix("@0.02"), fine["num_nodes"]
        usual = [row for row in rows if (row["planner"], row["num_nodes"]) == (planner, size)]
        for row in (*usual, fine):
            for stratum in ("all", "hard"):
                part = row["summary"][stratum]
                checks = part["configuration_checks"]
                where = f", N = {size}" if size else ""
                line = [label(planner) + where, f"{row['settings']['resolution']:g}", stratum]
                line += [cell(part["success"], ".1f", 100), cell(checks, ".0f", key="median")]
                line += [cell(checks, ".0f"), cell(part["cost"], ".2f")]
                lines.append([*line, cell(part["certified"], ".1f", 100)])
    head = ["planner", "tested every, rad", "problems", "solved, %"]
    head += ["configuration checks, median", "mean", "cost", "certified, %"]
    return markdown(head, lines) if lines else ""


def verdict(results: Row) -> str:
    """Whether the default planner, told that checks are dear, needs fewer of either kind than each
    of the others, at every roadmap size, and their intervals are apart."""
    seven = Measured(of_set(results, "test"))

    def compared(quantity: str, name: str, form: str) -> Finding:
        lows = {p: min(seven.each(p, quantity, key="low")) for p in FIGURE5 if p != "gnn"}
        rival = min(lows, key=lambda planner: lows[planner])
        fewer = max(seven.each("guided_dear", quantity, key="high")) < lows[rival]
        ours, theirs = (span(seven.each(p, quantity), form) for p in ("guided_dear", rival))
        others = listing([label(planner) for planner in lows])
        text = f"{ours} {name} for {label('guided_dear')}, {theirs} for {label(rival)}"
        return Finding(fewer, f"{text}, the fewest of {others}")

    lazy = span(seven.each("lazysp", "edge_checks"), ".1f")
    nodes = span(seven.each("gnn", "configuration_checks"), ".0f")
    medians = [
        span(seven.each(planner, "configuration_checks", key="median"), ".0f")
        for planner in ("guided_dear", "ompl:rrt_connect")
    ]
    return judge(
        compared("edge_checks", "edge checks in the mean", ".1f"),
        compared("configuration_checks", "configuration checks with those of sampling", ".0f"),
        beside=[
            f"lazysp, which checks lazily without any network, makes {lazy} edge checks.",
            f"gnn, which tests all nodes first, tests {nodes} configurations.",
            f"In the median {label('guided_dear')} tests {medians[0]}, RRT-Connect {medians[1]}.",
        ],
    )


EXPERIMENT = Experiment(
    name="figure5",
    title="Seven joints, over roadmap sizes",
    claim="A guide finds paths with fewer collision checks than PRM, RRT* and BIT* in R^7.",
    config=Figure5Config,
    quick={
        "num_nodes": (30,),
        "num_problems": 3,
        "guided_num_nodes": (30,),
    },
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
