"""A summary of results as a table on the terminal."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gnnjax.planning.options import PlannerOptions

# What a summary's title says of options that are not at their defaults.
_VARIANTS = {
    "simplify": (True, "simplified"),
    "shorten": (False, "not shortened"),
    "sampled": (True, "on sampled roadmaps"),
}
# What it says of others, where these differ between results beside each other.
_VALUES: dict[str, Callable[[Any], str]] = {
    "weights": lambda value: f"weights {Path(*Path(value).parts[-2:])}",
    "effort": lambda value: f"effort {value}",
    "max_roadmaps": lambda value: f"{value} roadmaps at most",
    "checker": lambda value: f"checker {value}",
    "resolution": lambda value: f"resolution {value:g}",
    "margin": lambda value: f"margin {1e3 * value:g} mm",
    "check_cost": lambda value: f"checks of {value:g} us",
    "rest_share": lambda value: f"at rest within {value:g}",
}
_DEFAULTS = {field.name: field.default for field in dataclasses.fields(PlannerOptions)}
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


def titles_of(all_settings: Sequence[dict[str, Any]]) -> list[str]:
    """How planners with some settings are called beside each other."""
    titles = [title_of(settings) for settings in all_settings]
    for name, told in _VALUES.items():
        default = _DEFAULTS.get(name)
        values = [settings.get(name, default) for settings in all_settings]
        if any(value != values[0] for value in values):
            named = zip(titles, values, strict=True)
            titles = [x if value == default else f"{x}, {told(value)}" for x, value in named]
    return titles


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
