"""Runs all experiments and writes their results into the texts.

    python -m experiments.run_all

Problem sets, and networks that are not shipped, are made where they are missing. What was measured
before is kept, in `runs/`, so that the command goes on where it was cut off. `--quick` runs
everything on a few problems and writes no texts.
"""

import dataclasses
from collections.abc import Callable

import tyro
from rich.console import Console

from experiments import (
    ablation,
    arms,
    crossover,
    failures,
    figure5,
    figure7,
    hard,
    predictor,
    report,
)
from experiments.measure import ExperimentConfig
from gnnjax.errors import InputError, run_command

# In the order in which they share runs: crossover, hard and failures read those of figure5.
EXPERIMENTS: dict[str, tuple[type[ExperimentConfig], Callable]] = {
    "figure5": (figure5.Figure5Config, figure5.run),
    "figure7": (figure7.Figure7Config, figure7.run),
    "crossover": (crossover.CrossoverConfig, crossover.run),
    "hard": (hard.HardConfig, hard.run),
    "failures": (failures.FailuresConfig, failures.run),
    "arms": (arms.ArmsConfig, arms.run),
    "predictor": (predictor.PredictorConfig, predictor.run),
    "ablation": (ablation.AblationConfig, ablation.run),
}


@dataclasses.dataclass(frozen=True)
class RunAllConfig(ExperimentConfig):
    """Run all experiments and refresh docs/results.md, docs/paper.md and the README's tables."""

    only: tuple[str, ...] = tuple(EXPERIMENTS)
    """Experiments to run."""


def run(config: RunAllConfig) -> None:
    """Runs the experiments one after the other, then writes the texts."""
    unknown = [name for name in config.only if name not in EXPERIMENTS]
    if unknown:
        raise InputError(f"no experiment {unknown[0]!r}; there are {list(EXPERIMENTS)}")
    shared = {f.name: getattr(config, f.name) for f in dataclasses.fields(ExperimentConfig)}
    console = Console()
    for name in config.only:
        make, experiment = EXPERIMENTS[name]
        console.rule(name)
        experiment(make(**shared))
    if not config.quick:
        report.run(report.ReportConfig(results=config.out))


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(RunAllConfig)))
