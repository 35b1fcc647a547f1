"""Names and colors of the planners, the same in all figures and tables, and bars and lines of
them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, LogLocator, NullLocator

from experiments.statistics import BAND

COLORS = {
    "guided": "darkblue",
    "guided_dear": "mediumblue",
    "guided_roadmap": "slateblue",
    "guided_sampled": "turquoise",
    "guided_shipped": "midnightblue",
    "guided_own": "royalblue",
    "guided_other": "skyblue",
    "gnn": "tab:red",
    "gnn_lazy": "tab:pink",
    "gnn_own": "firebrick",
    "gnn_lazy_own": "palevioletred",
    "gnn_paper": "tab:brown",
    "distance": "tab:orange",
    "lazysp": "tab:green",
    "prm": "tab:blue",
    "oracle": "black",
    "ompl:rrt_connect": "tab:purple",
    "ompl:rrt_connect@simplified": "orchid",
    "ompl:bit_star": "tab:olive",
    "ompl:rrt_star": "tab:gray",
    "ompl:prm": "tab:cyan",
    "vamp_cost": "silver",
    "vamp_simplified_cost": "dimgray",
}

_LABELS = {
    "guided_dear": "guided, dear checks",
    "guided_roadmap": "guided, not shortened",
    "guided_sampled": "guided, same roadmaps",
    "guided_shipped": "guided, shipped network",
    "guided_own": "guided, network of this arm",
    "guided_other": "guided, network of the Kuka",
    "guided@0.02": "guided, every 0.02 rad",
    "gnn_own": "gnn, trained on this arm",
    "gnn_lazy_own": "gnn_lazy, trained on this arm",
    "gnn_paper": "paper's network, one roadmap",
    "ompl:rrt_connect": "RRT-Connect",
    "ompl:rrt_connect@0.02": "RRT-Connect, every 0.02 rad",
    "ompl:rrt_connect@simplified": "RRT-Connect, simplified",
    "ompl:bit_star": "BIT*",
    "ompl:rrt_star": "RRT*",
    "ompl:prm": "PRM (OMPL)",
    "ompl:lazy_prm": "LazyPRM",
    "ompl:ait_star": "AIT*",
    "ompl:eit_star": "EIT*",
    "vamp_cost": "VAMP, as published",
    "vamp_simplified_cost": "VAMP, simplified, as published",
}


def label(planner: str) -> str:
    """What a planner is called in figures and tables."""
    return _LABELS.get(planner, planner)


def draw_bars(
    axes: Axes,
    values: Mapping[str, Sequence[dict[str, Any] | float | None]],
    groups: Sequence[str],
    scale: float = 1.0,
    looks: Mapping[str, tuple[str, str]] | None = None,
) -> None:
    """Draws means with their 95 % intervals: a group of bars a place on x, a bar a planner.

    Args:
        axes: where.
        values: of each planner, the statistics for each group, or a number that has no interval;
            None leaves a gap.
        groups: names of the groups.
        scale: factor of all numbers.
        looks: colors and names of what is no planner.
    """
    width = 0.84 / len(values)
    for number, (planner, statistics) in enumerate(values.items()):
        there = [(group, v) for group, v in enumerate(statistics) if v is not None]
        at = [group + width * (number - (len(values) - 1) / 2) for group, _ in there]
        bands = [[v[k] for k in BAND] if isinstance(v, dict) else [v] * 3 for _, v in there]
        mean, low, high = scale * np.array(bands, float).reshape(-1, 3).T
        error = np.maximum([mean - low, high - mean], 0)  # rounding
        color, name = (COLORS[planner], label(planner)) if looks is None else looks[planner]
        axes.bar(
            at,
            mean,
            0.94 * width,
            yerr=error if (error > 0).any() else None,
            color=color,
            label=name,
            error_kw={"elinewidth": 0.8},
        )
    axes.set_xticks(range(len(groups)), groups)


def draw_lines(
    figure: Figure,
    rows: Sequence[dict[str, Any]],
    names: Sequence[str],
    panels: Sequence[tuple[str, str, float, bool]],
) -> None:
    """Draws means with their 95 % intervals, a line a row, of all problems and of the hard ones.

    Args:
        figure: whose panels are side by side.
        rows: of the results, the first at the top.
        names: of the lines.
        panels: of each its quantity, title, factor, and whether it is logarithmic.
    """
    axes, at = figure.subplots(1, len(panels), sharey=True), -np.arange(len(rows))
    for panel, (quantity, title, scale, logarithmic) in zip(axes, panels, strict=True):
        for stratum, color in {"all": "tab:blue", "hard": "tab:red"}.items():
            parts = [row["summary"][stratum][quantity] for row in rows]
            there = [i for i, part in enumerate(parts) if part is not None]
            mean, low, high = (np.array([scale * parts[i][key] for i in there]) for key in BAND)
            spread = np.maximum([mean - low, high - mean], 0.0)
            panel.errorbar(
                mean, at[there], xerr=spread, fmt=".", color=color, capsize=2, label=stratum
            )
        panel.set(title=title)
        panel.grid(axis="x", alpha=0.3)
        if logarithmic:
            panel.set_xscale("log")
            panel.xaxis.set_major_formatter("{x:g}")
            panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            panel.xaxis.set_minor_locator(NullLocator())
    axes[0].set_yticks(at, names)
    axes[0].legend()


def make_logarithmic(axes: Axes, which: str = "y") -> None:
    """Makes axes, "x", "y" or "xy", logarithmic, with numbers as one says them: 60, not 6e1."""
    for name in which:
        axes.set(**{f"{name}scale": "log"})
        axis = axes.xaxis if name == "x" else axes.yaxis
        axis.set_major_formatter(_Plain(labelOnlyBase=True))
        axis.set_minor_formatter(_Plain(labelOnlyBase=False))


class _Plain(LogFormatter):
    def __call__(self, x: float, pos: int | None = None) -> str:
        if not super().__call__(x, pos):
            return ""  # of which ticks there would be too many
        return f"{x:,.0f}" if x >= 1 else f"{x:g}"
