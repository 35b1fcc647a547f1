"""Claim: one motion network serves several arms as well as one of their own.

    python -m experiments.arms

The default planner on the Kinova (or `--arms franka_panda`, kept out of all training) with
the shipped weights, which were trained on the Kuka and the Kinova, beside weights that were trained
on the arm alone, and weights that were trained on the Kuka alone, both for 300 batches; the shipped
weights saw 1,500 of either arm. LazySP and RRT-Connect stand beside them. N = 400, 100 problems of
the paper's distribution.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments import training
from experiments.cases import classical_case, own_case
from experiments.measure import ExperimentConfig, measure, problem_set, run_seed, save_results
from experiments.style import BAND, draw_bars
from gnnjax.errors import run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.files import atomic_write
from gnnjax.train_motion import TrainMotionConfig

CLAIM = "One motion network serves several arms as well as one of their own."
PLANNERS = ("guided", "guided_own", "guided_other", "lazysp", "ompl:rrt_connect")
COMPARED = ("edge_checks", "configuration_checks")
_RESAMPLES = 2000


@dataclasses.dataclass(frozen=True)
class ArmsConfig(ExperimentConfig):
    """The default planner on several arms, with weights of one network and of their own."""

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


def run(config: ArmsConfig) -> None:
    """Trains and measures what is missing, and draws the figure."""
    if config.robot:
        config = dataclasses.replace(config, arms=(config.robot,))
    if config.quick:
        config = dataclasses.replace(
            config,
            arms=config.arms[:1],
            other=config.arms[0],
            num_nodes=30,
            num_problems=3,
            seeds=config.seeds[:1],
            steps=2,
        )
    rows = save_results(config, "arms", CLAIM, _rows(config))
    draw(rows, config.out / "arms.png")


def _rows(config: ArmsConfig) -> Iterator[dict[str, Any]]:
    for arm in config.arms:
        named = cases(config, arm)
        own = _problems(config, named["guided_own"])
        for planner, case in named.items():
            row = {"arm": Path(arm).stem, "planner": planner}
            row["num_nodes"] = None if planner.startswith("ompl:") else config.num_nodes
            found = _problems(config, case)
            ratios = {name: ratio_of_means(found, own, name) for name in COMPARED}
            yield row | measure(case, config.seeds, config.runs) | {"to_own": ratios}


def cases(config: ArmsConfig, arm: str) -> dict[str, EvaluateConfig]:
    """The planners by name; their networks are trained if they are missing."""
    num = config.num_problems
    problems = problem_set(config, arm, num_problems=num)

    def own(planner: str, **changes: Any) -> EvaluateConfig:
        case = own_case(problems, arm, planner, config.num_nodes, num)
        return dataclasses.replace(case, **changes)

    return {
        "guided": own("guided"),
        "guided_own": own("guided", weights=training.trained(train_config(config, arm))),
        "guided_other": own("guided", weights=training.trained(train_config(config, config.other))),
        "lazysp": own("lazysp"),
        "ompl:rrt_connect": classical_case(problems, arm, "ompl:rrt_connect", num),
    }


def train_config(config: ArmsConfig, arm: str) -> TrainMotionConfig:
    """The training on one arm."""
    name = f"motion_{Path(arm).stem}"
    small: dict[str, Any] = {"scenes": 2, "motions": 16} if config.quick else {}
    out = config.trained / (f"{name}_quick" if config.quick else name)
    return TrainMotionConfig(robots=(arm,), out=out, steps=config.steps, **small)


def _problems(config: ArmsConfig, case: EvaluateConfig) -> list[list[dict]]:
    return [run_seed(case, seed, config.runs)["problems"] for seed in config.seeds]


def ratio_of_means(
    ours: list[list[dict]], theirs: list[list[dict]], quantity: str
) -> dict[str, float] | None:
    """Mean of a quantity over the mean of another planner's, on the same valid problems, with its
    95 % bootstrap interval over problems."""
    valid = np.array([row["valid"] for row in ours[0]])
    sums = [
        np.array([[row[quantity] for row in seed] for seed in rows], float)[:, valid].sum(axis=0)
        for rows in (ours, theirs)
    ]
    if not valid.any() or not sums[1].any():
        return None
    num = len(sums[0])
    chosen = np.random.default_rng(0).integers(num, size=(_RESAMPLES, num))
    with np.errstate(divide="ignore", invalid="ignore"):
        resampled = sums[0][chosen].sum(axis=1) / sums[1][chosen].sum(axis=1)
    resampled = resampled[np.isfinite(resampled)]
    low, high = np.quantile(resampled, [0.025, 0.975])
    values = sums[0].sum() / sums[1].sum(), low, high
    return {name: float(value) for name, value in zip(BAND, values, strict=True)}


PANELS = (
    ("edge_checks", "edge checks", 1.0),
    ("configuration_checks", "configuration checks", 1.0),
    ("success", "solved [%]", 100.0),
)


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draws bars with intervals: hard problems, a group an arm."""
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    figure = Figure(figsize=(13, 3.8), layout="constrained")
    for axes, (name, title, scale) in zip(figure.subplots(1, 3), PANELS, strict=True):
        found = {(row["planner"], row["arm"]): row["summary"]["hard"][name] for row in rows}
        draw_bars(axes, {p: [found[p, arm] for arm in arms] for p in PLANNERS}, arms, scale)
        axes.set_title(title)
        if scale == 1.0 and axes.patches:  # there are hard problems
            axes.set_yscale("log")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    figure.suptitle("Hard problems: means with 95 % intervals")
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(ArmsConfig)))
