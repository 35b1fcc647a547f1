"""An experiment as a record: a claim, and what measures, draws, tabulates and judges it.

Everything that is said of an experiment is made from its results file, so that it can be said
again without measuring: the figure, the table, and the verdict, which compares in code. Running an
experiment is the same for all of them.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from experiments.measure import ExperimentConfig
from experiments.results import Row, save_results
from gnnjax.arguments import parse_arguments
from gnnjax.errors import run_command
from gnnjax.files import atomic_write


class Measurement(NamedTuple):
    """What an experiment measures, row by row, so that rows can be saved as they come."""

    rows: Iterable[Row]
    # Further entries of the results file, known before its rows.
    head: Mapping[str, Any] = MappingProxyType({})


class Experiment(NamedTuple):
    """A claim, and how it is tested."""

    name: str  # of its module and of its files
    title: str  # of its section in the texts
    claim: str
    config: type[ExperimentConfig]
    quick: Mapping[str, Any]  # options of a quick look
    measure: Callable[[Any], Measurement]  # takes a `config`
    draw: Callable[[Row], Figure]  # these three take what the results file holds
    table: Callable[[Row], str]
    verdict: Callable[[Row], str]


class Finding(NamedTuple):
    """A part of a claim: whether it holds, and the numbers that say so."""

    holds: bool
    text: str


def judge(*findings: Finding, beside: Iterable[str] = ()) -> str:
    """A verdict: which parts of a claim hold and which do not, then what is worth saying beside."""
    held = "; ".join(finding.text for finding in findings if finding.holds)
    failed = "; ".join(finding.text for finding in findings if not finding.holds)
    if not failed:
        verdict = [f"Holds: {held}."]
    elif not held:
        verdict = [f"Does not hold: {failed}."]
    else:
        verdict = [f"Holds in part: {held}.", f"What does not hold: {failed}."]
    return " ".join([*verdict, *beside])


def run(experiment: Experiment, config: ExperimentConfig) -> Row:
    """Measures what is missing, and writes the results and their figure; returns the results."""
    if config.quick:
        config = dataclasses.replace(config, seeds=config.seeds[:1], **experiment.quick)
    rows, head = experiment.measure(config)
    path = config.out / f"{experiment.name}.json"
    results = save_results(path, experiment.claim, rows, head)
    save_figure(experiment.draw(results), path.with_suffix(".png"))
    return results


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a figure at its own resolution."""
    atomic_write(path, figure.savefig)


def main(experiment: Experiment) -> None:
    """The command of an experiment: runs it and prints its verdict, unless it was a quick look,
    which decides nothing."""

    def command() -> None:
        config = parse_arguments(experiment.config)
        results = run(experiment, config)
        if not config.quick:
            print(f"{experiment.claim} {experiment.verdict(results)}")

    run_command(command)


def section(experiment: Experiment, results: Row) -> str:
    """What docs/results.md says of an experiment."""
    name = experiment.name
    return "\n".join(
        [
            f"## {experiment.title}\n",
            f"Claim: {experiment.claim} {experiment.verdict(results)}\n",
            f"`python -m experiments.{name}`, [JSON](../results/{name}.json)\n",
            f"![{experiment.title}](../results/{name}.png)\n",
            experiment.table(results),
        ]
    )
