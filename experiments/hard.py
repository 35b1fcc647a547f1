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
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.cases import classical_case, nodes_of, own_case
from experiments.measure import (
    ExperimentConfig,
    command,
    measure,
    measure_problems,
    problem_set,
    problem_sets,
)
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row, of_set
from experiments.statistics import summarize_seeds
from experiments.strata import BOXES, CLEARANCES, LINES, strata
from experiments.style import draw_bars, label, make_logarithmic
from experiments.tables import SETS, cell, markdown, span
from gnnjax.evaluate import EvaluateConfig
from gnnjax.problems.families import BOX_FAMILIES

PLANNERS = (
    *("guided", "guided_dear", "gnn", "gnn_lazy", "distance", "lazysp", "oracle", "prm"),
    *("ompl:rrt_connect", "ompl:bit_star"),
)
FAMILY_PLANNERS = (
    *("guided", "guided_dear"),
    *("gnn", "gnn_lazy", "distance", "lazysp", "ompl:rrt_connect", "ompl:bit_star"),
)


@dataclasses.dataclass(frozen=True)
class HardConfig(ExperimentConfig):
    """Strata of the problems by how hard they are, and families of hard scenes."""

    num_nodes: int = 1000
    """Nodes of a roadmap."""
    num_problems: int = 300
    """Problems of each set of Figure 5."""
    families: tuple[str, ...] = (*BOX_FAMILIES, "cans", "pipes")
    """Families of scenes."""
    family_problems: int = 50
    """Problems of each family."""
    family_planners: tuple[str, ...] = FAMILY_PLANNERS
    """Planners for the families."""
    guided_sizes: tuple[int, ...] = (1000,)
    """Roadmap sizes of guided_dear on the families."""


def measurement(config: HardConfig) -> Measurement:
    """Rows of planners on strata and families."""
    return Measurement(_rows(config, config.robot or "kuka_iiwa14"))


def _rows(config: HardConfig, robot: str) -> Iterator[Row]:
    for name, path in problem_sets(config, robot, config.num_problems).items():
        yield from _strata_rows(config, robot, name, path)
    for family in config.families:
        path = problem_set(config, robot, family=family, num_problems=config.family_problems)
        for planner in config.family_planners:
            for size in config.guided_sizes if planner == "guided_dear" else (config.num_nodes,):
                sized = dataclasses.replace(config, num_nodes=size)
                case = _case(sized, path, robot, planner, config.family_problems)
                key = {"set": family, "stratum": family, "planner": planner}
                yield key | {"num_nodes": nodes_of(case)} | measure(config, case)


def _strata_rows(config: HardConfig, robot: str, name: str, path: Path) -> Iterator[Row]:
    def rows_of(planner: str) -> tuple[EvaluateConfig, list[list[dict]]]:
        case = _case(config, path, robot, planner, config.num_problems)
        return case, measure_problems(config, case)

    chosen = strata(robot, path, rows_of("prm")[1][0])
    for planner in PLANNERS:
        case, per_seed = rows_of(planner)
        for stratum, members in chosen.items():
            yield {
                "set": name,
                "stratum": stratum,
                "planner": planner,
                "num_nodes": nodes_of(case),
                "command": command(case),
                "summary": summarize_seeds(per_seed, keep=lambda index, m=members: bool(m[index])),
            }


def _case(config: HardConfig, path: Path, robot: str, planner: str, num: int) -> EvaluateConfig:
    if planner.startswith("ompl:"):
        return classical_case(path, robot, planner, num)
    return own_case(path, robot, planner, config.num_nodes, num)


PANELS = (
    ("success", "solved [%]", 100.0),
    ("configuration_checks", "configuration checks, mean", 1.0),
)


def draw(results: Row) -> Figure:
    """Draws bars with intervals: a row of panels for the test set, the public one, and families."""
    size = next(row["num_nodes"] for row in results["rows"] if row["num_nodes"])  # the strata's
    rows = [row for row in results["rows"] if row["num_nodes"] in (None, size)]
    kinds = {name: [row for row in rows if row["set"] == name] for name in SETS}
    kinds["families"] = [row for row in rows if row["set"] not in kinds]
    kinds = {name: chosen for name, chosen in kinds.items() if chosen}
    figure = Figure(figsize=(20, 3.6 * len(kinds) + 0.8), dpi=100, layout="constrained")
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
                make_logarithmic(axes)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=8)
    figure.suptitle("Means with 95 % intervals; in brackets: problems of the stratum")
    return figure


def table(results: Row) -> str:
    """Strata of the problem sets, then families."""
    parts = ["Solved, and configuration checks as mean (median).\n"]
    for name, title in SETS.items():
        rows = of_set(results, name)
        parts += [f"### {title}\n", strata_table(rows)] if rows else []
    families = [row for row in results["rows"] if row["set"] not in SETS]
    parts += ["### Families of hard scenes\n", "![Families](families.png)\n"]
    return "\n".join([*parts, strata_table(families)])


def strata_table(rows: list[Row]) -> str:
    """Success and configuration checks, a row a stratum and a column a planner."""

    def column(row: Row) -> tuple[str, int | None]:
        return row["planner"], row["num_nodes"]

    planners = list(dict.fromkeys(map(column, rows)))
    largest = max((num for _, num in planners if num), default=None)
    names = [
        label(p) + (f", N = {num}" if num not in (None, largest) else "") for p, num in planners
    ]
    lines = []
    for stratum in dict.fromkeys(row["stratum"] for row in rows):
        chosen = {column(row): row["summary"] for row in rows if row["stratum"] == stratum}
        num = chosen[planners[0]]["all"]["num_problems"]
        if not num:
            continue
        cells = []
        for planner in planners:
            part = chosen[planner]["all"]
            cells.append(
                f"{cell(part['success'], '.0f', 100)} %, "
                f"{cell(part['configuration_checks'], '.0f')} "
                f"({cell(part['configuration_checks'], '.0f', key='median')})"
            )
        lines.append([stratum.replace("\n", " "), str(num), *cells])
    return markdown(["stratum", "problems", *names], lines)


def verdict(results: Row) -> str:
    """Whether RRT-Connect's checks over those of the default planner, told that checks are dear,
    rise with every stratum, from easy to hard, and whether it needs the fewest in every family."""
    means = {
        (row["set"], row["stratum"], row["planner"]): part["mean"]
        for row in results["rows"]
        if (part := row["summary"]["all"]["configuration_checks"]) is not None
    }
    rival = "ompl:rrt_connect"

    def ratio(name: str, stratum: str) -> float:
        return means[name, stratum, rival] / means[name, stratum, "guided_dear"]

    def rising(scale: str, strata: Iterable[str]) -> Finding:
        there = [stratum for stratum in strata if ("test", stratum, rival) in means]
        ratios = [ratio("test", stratum) for stratum in there]
        steps = ", ".join(f"{ratio:.1f} ({s})" for s, ratio in zip(there, ratios, strict=True))
        return Finding(all(a < b for a, b in pairwise(ratios)), f"{scale}: {steps}")

    names = dict.fromkeys(row["set"] for row in results["rows"] if row["set"] not in SETS)
    fewest = [
        all(
            means[name, name, "guided_dear"] < mean
            for (where, _, planner), mean in means.items()
            if where == name and planner not in ("guided", "guided_dear")
        )
        for name in names
    ]
    saved = span((ratio(name, name) for name in names), ".1f")
    families = (
        f"fewest checks in {sum(fewest)} of {len(names)} families, {label(rival)} {saved} "
        "times as many"
    )
    return judge(
        rising(f"by the line, checks of RRT-Connect over those of {label('guided_dear')}", LINES),
        rising("by boxes", BOXES),
        rising("by clearance", reversed(CLEARANCES)),
        Finding(all(fewest), families),
    )


EXPERIMENT = Experiment(
    name="hard",
    title="Hard problems",
    claim="The harder the problem, the more the guide saves.",
    config=HardConfig,
    quick={
        "num_nodes": 30,
        "num_problems": 3,
        "families": ("bin",),
        "family_problems": 2,
        # Scenes of their own kind are compiled anew for each planner.
        "family_planners": ("guided_dear", "ompl:rrt_connect"),
        "guided_sizes": (30,),
    },
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
