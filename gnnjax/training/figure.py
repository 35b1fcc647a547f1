"""Training curves: the records of a run as a picture."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from gnnjax.files import atomic_write
from gnnjax.plot import check_picture

# Titles of the panels; records have other names for what is drawn together.
_TITLES = {
    "loss": "training loss [nat]",
    "accuracy": "training: share that is told right",
    "edge_auc": "validation: edges, area under the curve",
    "validation_success": "validation: share of problems solved",
    "validation_edge_checks": "validation: edge checks",
    "validation_cost": "validation: cost of the path [rad]",
}
_COLUMNS = 3


def draw_training(records: list[dict[str, Any]], unit: str, name: str, out: str | Path) -> None:
    """Draws what a training has logged into a picture, a panel for all losses and so on.

    Args:
        records: of the run's log, at least one.
        unit: what they count: "step" or "epoch".
        name: of the run.
        out: picture file; its ending chooses the format.
    """
    check_picture(out)
    panels: dict[str, list[str]] = {"loss": []}  # the first, whatever the order of records
    for quantity in dict.fromkeys(name for record in records for name in record):
        if quantity not in (unit, "seconds"):
            panels.setdefault(_panel(quantity), []).append(quantity)
    rows = -(-len(panels) // _COLUMNS)
    figure = Figure(figsize=(11, 0.6 + 2.9 * rows), layout="constrained")
    grid = figure.subplots(rows, min(_COLUMNS, len(panels)), squeeze=False).ravel()
    for axes, (panel, quantities) in zip(grid, panels.items(), strict=False):
        for quantity in quantities:
            there = [record for record in records if quantity in record]
            at, values = ([record[key] for record in there] for key in (unit, quantity))
            few = len(there) <= 50
            axes.plot(at, values, marker="o" if few else None, markersize=3, label=quantity)
            if panel == "loss" and all(value > 0 for value in values):
                axes.set_yscale("log")
                axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.yaxis.set_major_formatter("{x:g}")
                axes.yaxis.set_minor_formatter("")
        axes.set_title(_TITLES.get(panel, panel), fontsize=11)
        axes.set_xlabel(unit)
        axes.xaxis.set_major_locator(MaxNLocator("auto", integer=True))
        axes.grid(color="0.9")
        if quantities != [panel]:
            axes.legend(fontsize=8)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    minutes = sum(record["seconds"] for record in records) / 60
    figure.suptitle(f"{name}: {unit} {records[-1][unit]}, after {minutes:.1f} min")
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


def _panel(quantity: str) -> str:
    """Where a quantity is drawn."""
    if quantity.startswith("edge_auc"):
        return "edge_auc"
    return next((end for end in ("loss", "accuracy") if quantity.endswith(end)), quantity)
