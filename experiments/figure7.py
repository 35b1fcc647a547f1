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

from matplotlib.figure import Figure

from experiments.cases import CLASSICAL, OURS, classical_case, nodes_of, own_case
from experiments.measure import ExperimentConfig, measure, problem_set
from experiments.published import FIGURE7
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Measured, Row
from experiments.style import COLORS, draw_bars, label, make_logarithmic
from experiments.tables import DETAIL, listing, measured_on, planner_table
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig
from gnnjax.training.weights import find_weights

GUIDANCE_METHODS = ("gnn", "gnn_lazy")
TRANSFERRED = Path("kuka_iiwa14")  # weights; by default an arm gets its own
TRANSFERRED_PLANNERS = (*GUIDANCE_METHODS, "gnn_paper")


@dataclasses.dataclass(frozen=True)
class Figure7Config(ExperimentConfig):
    """All planners on the Kinova's problems, one roadmap size."""

    num_nodes: int = 400
    """Nodes of a roadmap."""
    num_problems: int = 300
    """Problems of the set."""
    weights: Path = Path("kinova_gen3")
    """Network trained on the arm itself, a name or a folder; its rows are left out without it."""


def measurement(config: Figure7Config) -> Measurement:
    """Rows of planners, and what they save of the means of those that the paper compares with."""
    return Measurement(_rows(config), {"paper": FIGURE7})


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


def _rows(config: Figure7Config) -> Iterator[Row]:
    named = cases(config)
    compared = {
        planner: measure(config, named[planner])["summary"]["all"]
        for planner in (stated["than"] for stated in FIGURE7.values())
    }
    for planner, case in named.items():
        measured = measure(config, case)
        key = {"planner": planner, "num_nodes": nodes_of(case)}
        yield key | measured | {"saved": saved(measured["summary"]["all"], compared)}


def saved(summary: dict[str, Any], compared: dict[str, dict[str, Any]]) -> dict[str, float | None]:
    """What a planner saves of the means of those that the paper compares with, as shares.

    Args:
        summary: of the planner.
        compared: summaries of the others, by name.
    """
    shares: dict[str, float | None] = {}
    for quantity, stated in FIGURE7.items():
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
_NAMES = {"edge_checks": "edge checks", "planning_time_s": "planning time"}


def draw(results: Row) -> Figure:
    """Draws bars with their 95 % intervals; where the paper's savings would put its planner is
    dotted."""
    paper = results["paper"]
    by_name = {row["planner"]: row for row in results["rows"]}
    planners = [planner for planner in COLORS if planner in by_name]
    figure = Figure(figsize=(13, 7.2), dpi=110, layout="constrained")
    for index, (name, title, scale, logarithmic) in enumerate(PANELS, start=1):
        axes = figure.add_subplot(2, 3, index)
        summaries = {planner: by_name[planner]["summary"]["all"] for planner in planners}
        draw_bars(axes, {p: [summary[name]] for p, summary in summaries.items()}, [""], scale)
        if name in paper:
            than, share = paper[name]["than"], paper[name]["saved"]
            base, ours = summaries[than][name], by_name["gnn"]["saved"][name]
            if base is not None and ours is not None:
                axes.axhline(scale * base["mean"] * (1 - share), color="black", ls=":", lw=1.2)
                title += f"\ngnn: {_compared(ours, than)} (paper: {100 * share:.1f} % less)"
        axes.set_title(title)
        if logarithmic:
            make_logarithmic(axes)
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
    return figure


def _compared(saved: float, than: str) -> str:
    name = {"prm": "PRM"}.get(than, label(than))  # as the paper writes it
    return f"{100 * saved:.1f} % less than {name}" if saved > 0 else f"{1 - saved:.1f} times {name}"


def table(results: Row) -> str:
    """Planners with intervals."""
    rows = results["rows"]
    return "\n".join([measured_on(results, rows[0]) + "\n", planner_table(rows, DETAIL)])


def verdict(results: Row) -> str:
    """Whether every guide saves of the mean of each planner that the paper compares with."""
    saved = {row["planner"]: row["saved"] for row in results["rows"]}

    def compared(quantity: str, than: str) -> Finding:
        found = {planner: saved[planner][quantity] for planner in TRANSFERRED_PLANNERS}
        words = [f"{label(p)} {_compared(share, than)}" for p, share in found.items()]
        holds = all(share > 0 for share in found.values())
        return Finding(holds, f"{_NAMES[quantity]} in the mean: {listing(words)}")

    six = Measured(results["rows"])
    medians = [
        f"{label(p)} {1e3 * six.mean(p, 'planning_time_s', key='median'):.1f} ms"
        for p in ("ompl:bit_star", *TRANSFERRED_PLANNERS)
    ]
    return judge(
        *(compared(quantity, stated["than"]) for quantity, stated in results["paper"].items()),
        beside=[f"In the median, planning takes {listing(medians)}."],
    )


EXPERIMENT = Experiment(
    name="figure7",
    title="Six joints",
    claim="A guide trained in R^7 saves collision checks and planning time in R^6.",
    config=Figure7Config,
    quick={"num_nodes": 30, "num_problems": 3},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
