"""Writes the results into the texts: results.md, paper.md and certificate.md in docs/, a paragraph
of cluster.md there, and the README's tables.

    python -m experiments.report

Every number comes from the JSON in `results/`, or from what others state and this project's history
holds (`published.py`); none is typed by hand, and neither is whether a claim holds.
"""

import dataclasses
from pathlib import Path

from experiments import certificate_page, cluster_page, paper
from experiments.readme import readme
from experiments.record import section
from experiments.registry import EXPERIMENTS
from experiments.results import Row, load_results
from gnnjax.arguments import parse_arguments
from gnnjax.errors import run_command
from gnnjax.files import atomic_write


@dataclasses.dataclass(frozen=True)
class ReportConfig:
    """Write all texts that hold results."""

    results: Path = Path("results")
    """Where the JSON is."""
    docs: Path = Path("docs")
    """Where results.md, paper.md, certificate.md and cluster.md are."""
    readme: Path = Path("README.md")
    """Whose tables are replaced."""


def results_page(results: dict[str, Row]) -> str:
    """docs/results.md."""
    settings = results["figure5"]["rows"][0]["settings"]
    head = (
        "Made by `python -m experiments.run_all`, which measures, draws and writes this page; the "
        "numbers are those of the JSON files in `results/`, and so are the verdicts on "
        "the claims, which code draws from them. Cells are for all problems / for the hard ones, "
        "whose straight line is blocked. In brackets: 95 % intervals, bootstrapped over problems "
        "with all their seeds. Every configuration that a planner tests counts as a configuration "
        "check, sampling included, for every planner alike; edges are tested every "
        f"{settings['resolution']:g} rad, unless stated otherwise, and a planner that takes more "
        f"than {settings['time_limit']:g} s a problem has failed. The machine was shared with "
        "other work: times are to be compared with each other, not with those of other machines.\n"
    )
    sections = [section(each, results[name]) for name, each in EXPERIMENTS.items()]
    return "\n".join(["# Results\n", head, *sections])


def texts(config: ReportConfig) -> dict[Path, str]:
    """What every file with results should hold."""
    results = {name: load_results(config.results / f"{name}.json") for name in EXPERIMENTS}
    written = config.readme.read_text(encoding="utf-8")
    cluster = config.docs / "cluster.md"
    return {
        config.readme: readme(written, results["figure5"], config.readme),
        config.docs / "results.md": results_page(results),
        config.docs / "cluster.md": cluster_page.page(
            cluster.read_text(encoding="utf-8"), results["throughput"], cluster
        ),
        config.docs / "paper.md": paper.page(results),
        config.docs / "certificate.md": certificate_page.page(
            certificate_page.load_campaigns(config.results)
        ),
    }


def run(config: ReportConfig) -> None:
    """Writes the texts."""
    for path, text in texts(config).items():
        atomic_write(path, lambda file, text=text: file.write_text(text, encoding="utf-8"))
        print(f"wrote {path}")


if __name__ == "__main__":
    run_command(lambda: run(parse_arguments(ReportConfig)))
