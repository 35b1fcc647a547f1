"""Claim: the distance field guides with fewer checks, and sooner, than what knows less or learned.

    python -m experiments.guides

Guides as equals: each is an argument of the same engine, which plans the same problems with the
same options and seeds: first as users have it, then without shortening, so that the search of the
roadmap alone can be seen. Problems are the Kuka's test set and families of hard scenes, in one
array, so that each guide is compiled once a mode (and boxes count as rotated for all). One problem
is planned by all guides in turn before the next one is, so that whatever else the machine does
slows all of them. Blocks of problems are kept in `runs/`, and a run that was cut off goes on with
the next one.

Guides are also asked about the edges of the stored roadmap, in the first scenes of each set: those
between free nodes, each once. Told is the area under the ROC curve, the log loss of exp(-price)
as the probability that an edge is free, and what a lone scene's edges take at least, its reading
included: priced one by one, and at once where a guide has a table of them. The oracle prices by
checking and pays nothing for it but time; it bounds what a guide can do on these roadmaps.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from experiments.guide_edges import ask, stored_edges
from experiments.in_turn import plan_in_turn, rows_of
from experiments.known_guides import KINDS
from experiments.measure import ExperimentConfig, problem_set
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.statistics import summarize_seeds
from experiments.style import draw_bars, make_logarithmic
from experiments.tables import cell, listing, made_on, markdown, span
from experiments.turns import folder_of, kept
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.errors import InputError
from gnnjax.planning.load import own_planner
from gnnjax.planning.options import make_options
from gnnjax.problems.families import BOX_FAMILIES
from gnnjax.problems.problem import Problem
from gnnjax.problems.shards import load_problems
from gnnjax.scene.scene import pad_scene

MODES = {"shortened": True, "roadmap": False}  # whether paths are shortened


@dataclasses.dataclass(frozen=True)
class GuidesConfig(ExperimentConfig):
    """Guides of the default planner in the same engine; of the seeds, the first alone."""

    guides: tuple[str, ...] = tuple(KINDS)
    """Who is compared."""
    num_nodes: int = 200
    """Of a problem's first roadmap."""
    num_problems: int = 300
    """Problems of the test set."""
    families: tuple[str, ...] = BOX_FAMILIES
    """Families of hard scenes."""
    family_problems: int = 20
    """Problems of each family."""
    scenes: int = 15
    """Of each set, in which guides are asked about edges."""


def measurement(config: GuidesConfig) -> Measurement:
    """Rows of guides, set by set."""
    unknown = [name for name in config.guides if name not in KINDS]
    if unknown or not config.guides:
        raise InputError(f"guides are {config.guides}; choose some of {list(KINDS)}")
    settings = {
        "robot": Path(config.robot or "kuka_iiwa14").stem,
        "num_nodes": config.num_nodes,
        "guides": list(config.guides),
        "num_problems": config.num_problems,
        "families": list(config.families),
        "family_problems": config.family_problems,
    }
    head = {"settings": settings | {"seed": config.seeds[0], "scenes": config.scenes}}
    return Measurement(_rows(config, settings), head)


def _rows(config: GuidesConfig, settings: Row) -> Iterator[Row]:
    robot = load_robot(config.robot or "kuka_iiwa14")
    files = _files(config)
    folder = folder_of(config.runs, "guides", settings, robot.path, *files.values())
    sets, problems = _all_problems(config, robot, files)
    guides = {name: KINDS[name].make(robot) for name in config.guides}

    def ask_all() -> dict[str, dict[str, Row]]:
        edges = {
            name: stored_edges(
                robot, rows_of(problems.scene, rows[: config.scenes]), config.num_nodes
            )
            for name, rows in sets.items()
        }
        return {name: ask(guide, edges) for name, guide in guides.items()}

    asked = kept(folder / f"edges_{config.scenes}.json", ask_all)
    planned = {}
    for mode, shorten in MODES.items():
        options = make_options("guided", num_nodes=config.num_nodes, shorten=shorten)
        makers = {
            name: functools.partial(own_planner, robot, options, guide)
            for name, guide in guides.items()
        }
        # A mode's planners are gone before the next one's are made: a process has no room for the
        # compiled code of all.
        planned[mode] = plan_in_turn(robot, makers, problems, config.seeds[:1], folder / mode)
    for name, members in sets.items():
        for guide in guides:
            summaries = {
                mode: summarize_seeds(planned[mode][guide], keep=members.__contains__)
                for mode in MODES
            }
            yield {"set": name, "guide": guide, "edges": asked[guide][name], **summaries}


def _files(config: GuidesConfig) -> dict[str, Path]:
    """The file of each set."""
    find = functools.partial(problem_set, config, config.robot or "kuka_iiwa14")
    files = {"test": find(num_problems=config.num_problems)}
    for family in config.families:
        files[family] = find(family=family, num_problems=config.family_problems)
    return files


def _all_problems(
    config: GuidesConfig, robot: Robot, files: dict[str, Path]
) -> tuple[dict[str, range], Problem]:
    """Which problems are of which set, and all of them with room for equally many boxes."""
    parts = {}
    for name, path in files.items():
        wanted = config.num_problems if name == "test" else config.family_problems
        parts[name] = load_problems(path, robot).take(slice(wanted)).problems
    most = max(part.scene.mask.shape[1] for part in parts.values())
    padded = [part._replace(scene=pad_scene(part.scene, most)) for part in parts.values()]
    last = np.cumsum([len(part.start) for part in padded]).tolist()
    sets = {
        name: range(end - len(part.start), end)
        for (name, part), end in zip(parts.items(), last, strict=True)
    }
    return sets, jax.tree.map(lambda *x: np.concatenate(x), *padded)


def of_guide(results: Row, guide: str) -> dict[str, Row]:
    """The rows of a guide by set."""
    return {row["set"]: row for row in results["rows"] if row["guide"] == guide}


PANELS = (
    ("edges", "area", "1 - area under the ROC curve"),
    ("shortened", "configuration_checks", "configuration checks, mean"),
    ("shortened", "total_time_s", "total time, median [ms]"),
)


def draw(results: Row) -> Figure:
    """Draws hard problems of all sets: how edges are told apart, checks, and time."""
    figure = Figure(figsize=(15, 4.4), dpi=100, layout="constrained")
    panels = figure.subplots(1, 3)
    sets = list(dict.fromkeys(row["set"] for row in results["rows"]))
    guides = list(dict.fromkeys(row["guide"] for row in results["rows"]))
    looks = {guide: (KINDS[guide].color, KINDS[guide].title) for guide in guides}
    for axes, (part, quantity, title) in zip(panels, PANELS, strict=True):
        heights = {}
        for guide in guides:
            rows = of_guide(results, guide)
            if part == "edges":
                # The oracle's is none, which no logarithmic axis shows.
                heights[guide] = [max(1 - rows[name]["edges"][quantity], 1e-6) for name in sets]
            elif quantity == "total_time_s":
                heights[guide] = [1e3 * _hard(rows[n], part, quantity, "median") for n in sets]
            else:
                heights[guide] = [_hard(rows[name], part, quantity, "mean") for name in sets]
        draw_bars(axes, heights, sets, looks=looks)
        axes.set(title=title)
        make_logarithmic(axes)
    panels[0].set_ylim(1e-4, 1)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.suptitle("Problems whose straight line is blocked")
    return figure


def _hard(row: Row, mode: str, quantity: str, key: str) -> float:
    part = row[mode]["hard"][quantity]
    return float("nan") if part is None else part[key]


def table(results: Row) -> str:
    """A table a set, a row a guide."""
    settings, machine = results["settings"], results["machine"]
    parts = [
        f"N = {settings['num_nodes']}, one seed. Planning: problems whose "
        "straight line is blocked, as users have it / paths not shortened. Edges: those of the "
        f"stored roadmap between free nodes, in {settings['scenes']} scenes; microseconds an edge "
        "of a lone scene, one by one / all edges from a table. The field without its table is the "
        "same guide as the field, looked at as a network is. "
        f"{made_on(machine)}.\n"
    ]
    head = ["guide", "area", "log loss", "us an edge", "solved, %", "edge checks, mean"]
    head += ["configuration checks, mean", "median", "cost, mean", "total, ms, median", "mean"]
    for name in dict.fromkeys(row["set"] for row in results["rows"]):
        rows = [row for row in results["rows"] if row["set"] == name]
        num = rows[0]["shortened"]["hard"]["num_problems"]
        parts.append(f"{'Test set' if name == 'test' else name.capitalize()} ({num} problems):\n")
        parts.append(markdown(head, [_line(row) for row in rows]))
    return "\n".join(parts)


def _line(row: Row) -> list[str]:
    edges = row["edges"]

    def both(quantity: str, form: str, scale: float = 1.0, key: str = "mean") -> str:
        found = [cell(row[mode]["hard"][quantity], form, scale, key) for mode in MODES]
        return " / ".join(found)

    clock = [edges["edge_s"], edges["table_edge_s"]]
    return [
        KINDS[row["guide"]].title,
        f"{edges['area']:.4f}",
        f"{edges['log_loss']:.3f}",
        " / ".join("-" if spent is None else f"{1e6 * spent:.2f}" for spent in clock),
        both("success", ".1f", 100),
        both("edge_checks", ".1f"),
        both("configuration_checks", ".0f"),
        both("configuration_checks", ".0f", key="median"),
        both("cost", ".2f"),
        both("total_time_s", ".1f", 1e3, "median"),
        both("total_time_s", ".1f", 1e3),
    ]


OWN = "field"  # the guide that the claim is about


def verdict(results: Row) -> str:
    """Whether the field needs fewer checks and less time than each other guide on every set, and
    how near it comes to the oracle."""
    needs = {guide: _needs(results, guide) for guide in results["settings"]["guides"]}
    guides = [guide for guide in needs if not KINDS[guide].is_bound]
    findings = []
    for rival in guides:
        if rival.startswith(OWN):  # itself
            continue
        ratios = np.stack([needs[rival][name] / ours for name, ours in needs[OWN].items()])
        checks, spent = (span(column.tolist(), ".2f") for column in ratios.T)
        text = f"{KINDS[rival].title} takes {checks} times the checks and {spent} times the time"
        findings.append(Finding(bool((ratios > 1).all()), text))
    best = []
    for name in needs[OWN]:
        unbeaten = [
            KINDS[guide].title
            for guide in guides
            if not any((needs[other][name] < needs[guide][name]).all() for other in guides)
        ]
        best.append(f"{name}: {listing(unbeaten)}")
    beside = [f"Beaten by none in checks and time together: {'; '.join(best)}."]
    if "oracle" in needs:
        share = [ours[0] / needs["oracle"][name][0] for name, ours in needs[OWN].items()]
        beside.append(f"The field takes {span(share, '.2f')} times the checks of the oracle.")
    return judge(*findings, beside=beside)


def _needs(results: Row, guide: str) -> dict[str, np.ndarray]:
    """By set: configuration checks in the mean, and the median total time."""
    return {
        name: np.array(
            [
                _hard(row, "shortened", "configuration_checks", "mean"),
                _hard(row, "shortened", "total_time_s", "median"),
            ]
        )
        for name, row in of_guide(results, guide).items()
    }


EXPERIMENT = Experiment(
    name="guides",
    title="Guides as equals",
    claim="The distance field, which nobody trains, guides with fewer checks and in less time than "
    "the length alone and than the motion network.",
    config=GuidesConfig,
    quick={
        "guides": ("length", "field"),
        "num_nodes": 30,
        "num_problems": 3,
        "families": ("bin",),
        "family_problems": 2,
        "scenes": 2,
    },
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)


if __name__ == "__main__":
    main(EXPERIMENT)
