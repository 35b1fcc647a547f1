"""Claim: the guide trained on the 7-joint arm also saves checks and time on a 6-joint one (R^6).

    python -m experiments.figure7

The paper's Figure 7 on the Kinova Gen3: N = 400, 300 test problems. The networks are those of the
Kuka, its seventh joint fixed, as in the paper. Beside them stand a network trained on the Kinova
itself, the default planner, whose network serves all arms, and the planners that the paper leaves
out: LazySP, a greedy walk by the distance to the goal, and RRT-Connect.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro
from matplotlib.figure import Figure

from experiments.cases import CLASSICAL, OURS, classical_case, own_case
from experiments.measure import ExperimentConfig, measure, problem_set, save_results
from experiments.style import COLORS, draw_bars
from gnnjax.errors import InputError, run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.files import atomic_write
from gnnjax.training.weights import find_weights

CLAIM = "A guide trained in R^7 saves collision checks and planning time in R^6."

# What the paper states of its Figure 7 in words: saved by its planner, as a share of the other's.
PAPER = {
    "edge_checks": {"than": "prm", "saved": 0.997},
    "planning_time_s": {"than": "ompl:bit_star", "saved": 0.986},
}
GUIDANCE_METHODS = ("gnn", "gnn_lazy")
TRANSFERRED = Path("kuka_iiwa14")  # weights; by default an arm gets its own


@dataclasses.dataclass(frozen=True)
class Figure7Config(ExperimentConfig):
    """All planners on the Kinova's problems, one roadmap size."""

    num_nodes: int = 400
    """Nodes of a roadmap."""
    num_problems: int = 300
    """Problems of the set."""
    weights: Path = Path("kinova_gen3")
    """Network trained on the arm itself, a name or a folder; its rows are left out without it."""


def run(config: Figure7Config) -> None:
    """Measures what is missing and draws the figure."""
    if config.quick:
        config = dataclasses.replace(config, num_nodes=30, num_problems=3, seeds=config.seeds[:1])
    rows = save_results(config, "figure7", CLAIM, _rows(config), paper=PAPER)
    draw(rows, config.out / "figure7.png")


def cases(config: Figure7Config) -> dict[str, EvaluateConfig]:
    """The planners by name."""
    robot, num = config.robot or "kinova_gen3", config.num_problems
    problems = problem_set(config, robot, num_problems=num)

    def own(planner: str, weights: Path | None = None) -> EvaluateConfig:
        case = own_case(problems, robot, planner, config.num_nodes, num)
        return case if weights is None else dataclasses.replace(case, weights=weights)

    named = {planner: own(planner) for planner in (*OURS, "gnn_paper")}
    named |= {planner: own(planner, TRANSFERRED) for planner in GUIDANCE_METHODS}
    try:
        find_weights(config.weights)
        named |= {f"{planner}_own": own(planner, config.weights) for planner in GUIDANCE_METHODS}
    except InputError as error:
        print(f"{error}; left out")
    return named | {planner: classical_case(problems, robot, planner, num) for planner in CLASSICAL}


def _rows(config: Figure7Config) -> Iterator[dict[str, Any]]:
    named = cases(config)
    compared = {
        planner: measure(named[planner], config.seeds, config.runs)["summary"]["all"]
        for planner in (stated["than"] for stated in PAPER.values())
    }
    for planner, case in named.items():
        measured = measure(case, config.seeds, config.runs)
        size = None if planner in CLASSICAL else config.num_nodes
        key = {"planner": planner, "num_nodes": size}
        yield key | measured | {"saved": saved(measured["summary"]["all"], compared)}


def saved(summary: dict[str, Any], compared: dict[str, dict[str, Any]]) -> dict[str, float | None]:
    """What a planner saves of the means of those that the paper compares with, as shares.

    Args:
        summary: of the planner.
        compared: summaries of the others, by name.
    """
    shares: dict[str, float | None] = {}
    for quantity, stated in PAPER.items():
        ours, theirs = summary[quantity], compared[stated["than"]][quantity]
        if ours is None or theirs is None or not theirs["mean"]:
            shares[quantity] = None
        else:
            shares[quantity] = 1 - ours["mean"] / theirs["mean"]
    return shares


PANELS = (
    ("edge_checks", "edge checks", 1.0, True),
    ("configuration_checks", "configuration checks", 1.0, True),
    ("planning_time_s", "planning time [ms]", 1e3, True),
    ("cost", "path cost [rad]", 1.0, False),
    ("success", "solved [%]", 100.0, False),
    ("certified", "certified [%]", 100.0, False),
)
_THAN = {"prm": "PRM", "ompl:bit_star": "BIT*"}


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draws bars with their 95 % intervals; where the paper's savings would put its planner is
    dotted."""
    by_name = {row["planner"]: row for row in rows}
    planners = [planner for planner in COLORS if planner in by_name]
    figure = Figure(figsize=(13, 7.2), layout="constrained")
    for index, (name, title, scale, logarithmic) in enumerate(PANELS, start=1):
        axes = figure.add_subplot(2, 3, index)
        summaries = {planner: by_name[planner]["summary"]["all"] for planner in planners}
        draw_bars(axes, {p: [summary[name]] for p, summary in summaries.items()}, [""], scale)
        if name in PAPER:
            than, share = PAPER[name]["than"], PAPER[name]["saved"]
            base, ours = summaries[than][name], by_name["gnn"]["saved"][name]
            if base is not None and ours is not None:
                axes.axhline(scale * base["mean"] * (1 - share), color="black", ls=":", lw=1.2)
                title += f"\ngnn: {_compared(ours, _THAN[than])} (paper: {100 * share:.1f} % less)"
        axes.set_title(title)
        if logarithmic:
            axes.set_yscale("log")
        elif scale == 100:
            axes.set_ylim(0, 100)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    for axes in figure.axes[1:]:  # a planner that has no edges is in other panels only
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            if text not in labels:
                handles, labels = [*handles, handle], [*labels, text]
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    figure.suptitle(
        "Means with 95 % intervals; dotted: what the paper's savings would leave of our baseline"
    )
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


def _compared(saved: float, than: str) -> str:
    return f"{100 * saved:.1f} % less than {than}" if saved > 0 else f"{1 - saved:.1f} times {than}"


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(Figure7Config)))
