"""A summary of results as a table on the terminal."""

from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

# What a summary's title says of options that are not at their defaults.
_VARIANTS = {
    "simplify": (True, "simplified"),
    "shorten": (False, "not shortened"),
    "sampled": (True, "on sampled roadmaps"),
}
_WITH_UNITS = (("cost", "[rad]"), ("planning", "[ms]"), ("total", "[ms]"))


def title_of(settings: dict[str, Any]) -> str:
    """How a planner with some settings is called."""
    title = settings["planner"]
    if not title.startswith("ompl:"):
        title += f", {settings['num_nodes']} nodes"
    for name, (value, words) in _VARIANTS.items():
        if settings[name] == value:
            title += f", {words}"
    return title + "".join(f", own {part}" for part in settings.get("own", []))


def print_summary(results: dict[str, Any]) -> None:
    """Prints a summary as a table."""
    summary = results["summary"]
    table = Table(
        *("stratum", "solved", "certified", "edge\nchecks", "configuration\nchecks"),
        *(f"{name}\n{escape(unit)}" for name, unit in _WITH_UNITS),
        title=title_of(results["settings"]),
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
    )
    for stratum in ("all", "hard"):
        part = summary[stratum]
        if not part["num_problems"]:
            continue

        def text(name: str, form: str, scale: float = 1.0, part: dict = part) -> str:
            if part[name] is None:
                return "-"
            mean, median = part[name]["mean"] * scale, part[name]["median"] * scale
            return f"{mean:{form}}\n({median:{form}})"

        table.add_row(
            f"{stratum} ({part['num_problems']})",
            f"{100 * part['success']:.1f} %",
            f"{100 * part['certified']:.1f} %",
            text("edge_checks", ".1f"),
            text("configuration_checks", ".0f"),
            text("cost", ".2f"),
            text("planning_time_s", ".1f", 1e3),
            text("total_time_s", ".1f", 1e3),
        )
    console = Console()
    console.print(table)
    console.print("mean (median); times are of compiled code")
    if summary["num_invalid"]:
        console.print(
            f"{summary['num_invalid']} invalid problems left out: {summary['invalid_problems']}"
        )
