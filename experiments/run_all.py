"""Runs all experiments and writes their results into the texts.

    python -m experiments.run_all

Problem sets, and networks that are not shipped, are made where they are missing. What this very
code has measured before is kept, in `runs/`, so that the command goes on where it was cut off; what
other code has measured lies beside it, and does not count. `--quick` runs everything on a few
problems and writes no texts. An experiment whose problems others publish keeps its results where
these problems are not there.
"""

import dataclasses

from rich.console import Console

from experiments import record, report
from experiments.measure import ExperimentConfig, MissingProblems
from experiments.registry import EXPERIMENTS
from gnnjax.arguments import parse_arguments
from gnnjax.errors import InputError, run_command


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
        console.rule(name)
        try:
            record.run(EXPERIMENTS[name], EXPERIMENTS[name].config(**shared))
        except MissingProblems as error:
            console.print(f"left as it was: {error}")
    if not config.quick:
        report.run(report.ReportConfig(results=config.out))


if __name__ == "__main__":
    run_command(lambda: run(parse_arguments(RunAllConfig)))
