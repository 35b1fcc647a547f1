"""Summaries of results, several planners' side by side, as a picture."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gnnjax.files import atomic_write
from gnnjax.plot import check_picture

# Of the strata: colour, and where in a planner's row.
_STRATA = {"all": ("tab:blue", -0.17), "hard": ("tab:orange", 0.17)}
# What is drawn of each problem's numbers: title, and what they are multiplied by.
_PANELS = {
    "cost": ("cost of the path [rad]", 1.0),
    "edge_checks": ("edge checks", 1.0),
    "configuration_checks": ("configuration checks", 1.0),
    "planning_time_s": ("planning time [ms]", 1e3),
    "total_time_s": ("total time [ms]", 1e3),
}
_WIDE = 30.0  # largest by least of a panel, from which on its axis is logarithmic


def draw_summary(summaries: Mapping[str, dict[str, Any]], title: str, out: str | Path) -> None:
    """Draws summaries of results into a picture: success, cost, checks and times.

    Args:
        summaries: of each planner, by what it is to be called; see `summarize`.
        title: of the picture.
        out: picture file; its ending chooses the format.
    """
    check_picture(out)
    names = list(summaries)
    figure = Figure(figsize=(11, 2.9 + 0.75 * len(names)), layout="constrained")
    grid = figure.subplots(2, 3, sharey=True).ravel()
    first = grid[0]
    _draw_shares(first, list(summaries.values()))
    for axes, (quantity, (words, scale)) in zip(grid[1:], _PANELS.items(), strict=True):
        _draw_quantity(axes, list(summaries.values()), quantity, scale)
        axes.set_title(words, fontsize=11)
    for axes in grid:
        axes.grid(axis="x", color="0.9")
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
    first.set_yticks(range(len(names)), names)
    first.set_ylim(len(names) - 0.5, -0.5)  # the first planner is the uppermost
    numbers = {part: {s[part]["num_problems"] for s in summaries.values()} for part in _STRATA}
    words = {"all": "all problems", "hard": "those whose straight line is blocked"}
    handles = [
        Line2D([], [], color=color, marker="o", label=f"{words[part]} ({_range(numbers[part])})")
        for part, (color, _) in _STRATA.items()
    ]
    handles += [
        Line2D([], [], color="0.3", marker="o", linestyle="", label="median"),
        Line2D([], [], color="0.3", marker="D", mfc="white", linestyle="", label="mean"),
        Line2D([], [], color="0.3", label="to the 95th percentile"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    figure.suptitle(title)
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


def _draw_shares(axes: Axes, summaries: list[dict[str, Any]]) -> None:
    """Bars of the problems that are solved; paler, those without a proof that the path is free."""
    for part, (color, offset) in _STRATA.items():
        for row, summary in enumerate(summaries):
            if not summary[part]["num_problems"]:
                continue
            solved, certified = (100 * summary[part][k] for k in ("success", "certified"))
            place = {"y": row + offset, "height": 0.3}
            axes.barh(width=solved, color=color, alpha=0.35, **place)
            axes.barh(width=certified, color=color, **place)
            inside = solved > 25
            axes.text(
                *(solved + (-1 if inside else 1), row + offset, f"{solved:.1f}"),
                ha="right" if inside else "left",
                va="center_baseline",
                color="white" if inside else "black",
                fontsize=9,
            )
    axes.set_xlim(0, 100)
    axes.set_title("solved [%] (pale: not certified)", fontsize=11)


def _draw_quantity(
    axes: Axes, summaries: list[dict[str, Any]], quantity: str, scale: float
) -> None:
    """Medians, means and 95th percentiles, a row a planner."""
    drawn = []
    for part, (color, offset) in _STRATA.items():
        for row, summary in enumerate(summaries):
            if summary[part][quantity] is None:  # no problem, or none solved
                continue
            keys = ("median", "mean", "p95")
            median, mean, most = (scale * summary[part][quantity][key] for key in keys)
            y = row + offset
            axes.plot([median, most], [y, y], color=color, linewidth=2, solid_capstyle="butt")
            axes.plot(median, y, "o", color=color, markersize=6)
            axes.plot(mean, y, "D", color=color, mfc="white", markersize=5)
            drawn += [median, mean, most]
    values = np.array(drawn)
    if len(values) and values.min() > 0 and values.max() > _WIDE * values.min():
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
    else:
        axes.set_xlim(left=0)


def _range(numbers: set[int]) -> str:
    low, high = min(numbers), max(numbers)
    return str(low) if low == high else f"{low} to {high}"
