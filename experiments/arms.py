"""Claim: one motion network serves several arms as well as one of their own.

    python -m experiments.arms

The guided planner on the Kinova (or `--arms franka_panda`, kept out of all training), guided by the
shipped motion network, which was trained on the Kuka and the Kinova, beside networks that were
trained on the arm alone and on the Kuka alone, both for 300 batches; the shipped one saw 1,500 of
either arm. Checks are said to be dear, or exact shortcuts, which ask no guide, would be most of
what is counted. The distance field, LazySP and RRT-Connect stand beside them. N = 400, 100 problems
of the paper's distribution.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from experiments import training
from experiments.cases import classical_case, nodes_of, own_case
from experiments.measure import ExperimentConfig, measure, measure_problems, problem_set
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.statistics import ratio_of_means
from experiments.style import draw_bars, label, make_logarithmic
from experiments.tables import DETAIL, both, interval, markdown, measured_on
from gnnjax.evaluate import EvaluateConfig
from gnnjax.train_motion import TrainMotionConfig

PLANNERS = (
    *("guided_shipped", "guided_own", "guided_other"),
    *("guided_dear", "lazysp", "ompl:rrt_connect"),
)
COMPARED = ("edge_checks", "configuration_checks")
_COLUMNS = ("solved, %", "edge checks", "configuration checks", "cost")


@dataclasses.dataclass(frozen=True)
class ArmsConfig(ExperimentConfig):
    """The guided planner on several arms, with weights of one network and of their own."""

    arms: tuple[str, ...] = ("kinova_gen3",)
    """The arms."""
    other: str = "kuka_iiwa14"
    """The arm that the third weights are trained on."""
    num_nodes: int = 400
    """Nodes of a roadmap."""
    num_problems: int = 100
    """Problems of each arm."""
    steps: int = 300
    """Of each training; the shipped network saw 1,500 of each of its arms."""
    trained: Path = Path("runs")
    """Where the networks go, each in a folder motion_ARM."""


def measurement(config: ArmsConfig) -> Measurement:
    """Rows of planners on each arm, and their means over those with the arm's own weights."""
    return Measurement(_rows(config))


def _rows(config: ArmsConfig) -> Iterator[Row]:
    for arm in (config.robot,) if config.robot else config.arms:
        named = cases(config, arm)
        own = measure_problems(config, named["guided_own"])
        for planner, case in named.items():
            row = {"arm": Path(arm).stem, "planner": planner, "num_nodes": nodes_of(case)}
            found = measure_problems(config, case)
            ratios = {name: ratio_of_means(found, own, name) for name in COMPARED}
            yield row | measure(config, case) | {"to_own": ratios}


def cases(config: ArmsConfig, arm: str) -> dict[str, EvaluateConfig]:
    """The planners by name; their networks are trained if they are missing."""
    num = config.num_problems
    other = arm if config.quick else config.other  # one training is enough for a look
    problems = problem_set(config, arm, num_problems=num)

    def own(planner: str, **changes: Any) -> EvaluateConfig:
        case = own_case(problems, arm, planner, config.num_nodes, num)
        return dataclasses.replace(case, **changes)

    def network(weights: Path) -> EvaluateConfig:
        return own("guided_dear", weights=weights)

    return {
        "guided_shipped": network(Path("motion")),
        "guided_own": network(training.trained(train_config(config, arm))),
        "guided_other": network(training.trained(train_config(config, other))),
        "guided_dear": own("guided_dear"),
        "lazysp": own("lazysp"),
        "ompl:rrt_connect": classical_case(problems, arm, "ompl:rrt_connect", num),
    }


def train_config(config: ArmsConfig, arm: str) -> TrainMotionConfig:
    """The training on one arm."""
    name = f"motion_{Path(arm).stem}"
    small: dict[str, Any] = {"scenes": 2, "motions": 16} if config.quick else {}
    out = config.trained / (f"{name}_quick" if config.quick else name)
    return TrainMotionConfig(robots=(arm,), out=out, steps=config.steps, **small)


PANELS = (
    ("edge_checks", "edge checks", 1.0),
    ("configuration_checks", "configuration checks", 1.0),
    ("success", "solved [%]", 100.0),
)


def draw(results: Row) -> Figure:
    """Draws bars with intervals: hard problems, a group an arm."""
    rows = results["rows"]
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    figure = Figure(figsize=(13, 3.8), dpi=110, layout="constrained")
    for axes, (name, title, scale) in zip(figure.subplots(1, 3), PANELS, strict=True):
        found = {(row["planner"], row["arm"]): row["summary"]["hard"][name] for row in rows}
        draw_bars(axes, {p: [found[p, arm] for arm in arms] for p in PLANNERS}, arms, scale)
        axes.set_title(title)
        if scale == 1.0 and axes.patches:  # there are hard problems
            make_logarithmic(axes)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    figure.suptitle("Hard problems: means with 95 % intervals")
    return figure


def table(results: Row) -> str:
    """The guided planner on each arm, with weights of different arms."""
    columns = [column for column in DETAIL if column[0] in _COLUMNS]
    lines = []
    for row in results["rows"]:
        ratios = [interval(row["to_own"][name], ".2f") for name in COMPARED]
        lines.append(
            [row["arm"], label(row["planner"])]
            + [both(row, write) for _, write in columns]
            + (ratios if row["planner"].startswith("guided") else ["-"] * len(ratios))
        )
    head = ["arm", "planner", *[title for title, _ in columns]]
    head += [f"{name.replace('_', ' ')} over those with its own weights" for name in COMPARED]
    note = measured_on(results, results["rows"][0]) + "\n"
    return note + "\n" + markdown(head, lines)


def verdict(results: Row) -> str:
    """Whether the shipped weights solve as much as an arm's own, within the interval, and need no
    more checks, or so few more that the interval holds none."""
    rows = {(row["arm"], row["planner"]): row for row in results["rows"]}
    findings = []
    for arm in dict.fromkeys(arm for arm, _ in rows):
        ours, own = rows[arm, "guided_shipped"], rows[arm, "guided_own"]
        solved, theirs = (row["summary"]["all"]["success"] for row in (ours, own))
        shares = f"{100 * solved['mean']:.1f} % solved, {100 * theirs['mean']:.1f} % with its own"
        findings.append(Finding(solved["high"] >= theirs["mean"], f"{arm}: {shares}"))
        for name, ratio in ours["to_own"].items():
            if ratio is not None:
                text = f"{arm}: {interval(ratio, '.2f')} times the {name.replace('_', ' ')}"
                findings.append(Finding(ratio["low"] <= 1, text))
    return judge(*findings)


EXPERIMENT = Experiment(
    name="arms",
    title="One network for all arms",
    claim="One motion network serves several arms as well as one of their own.",
    config=ArmsConfig,
    quick={"num_nodes": 30, "num_problems": 3, "steps": 2},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
