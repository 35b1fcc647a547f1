"""Rows of planners, a scene each and one for all of them: their figure, and their table."""

from matplotlib.figure import Figure

from experiments.results import Row
from experiments.style import draw_bars, label
from experiments.tables import cell, made_on, markdown

OWN = "guided"
RIVALS = ("ompl:rrt_connect", "ompl:rrt_connect@simplified", "ompl:bit_star")
ALL = "all scenes"
# What a set may state of others, by the names of its arrays.
PUBLISHED = ("vamp_cost", "vamp_simplified_cost")


def of_planner(results: Row, planner: str) -> dict[str, Row]:
    """A planner's rows by scene."""
    return {row["scene"]: row for row in results["rows"] if row["planner"] == planner}


def draw(results: Row) -> Figure:
    """Draws the share that is solved, and the mean cost, a group of bars a scene."""
    figure = Figure(figsize=(11, 4.2), dpi=100, layout="constrained")
    panels = figure.subplots(1, 2)
    scenes = list(of_planner(results, OWN))
    planners = [name for name in (OWN, *RIVALS, *PUBLISHED) if of_planner(results, name)]
    rows = {planner: of_planner(results, planner) for planner in planners}
    shares = {
        planner: [own[scene].get("success_of_all") for scene in scenes]
        for planner, own in rows.items()
    }
    costs = {
        planner: [cost and cost["mean"] for cost in (own[scene]["cost"] for scene in scenes)]
        for planner, own in rows.items()
    }
    draw_bars(panels[0], shares, scenes, 100)
    draw_bars(panels[1], costs, scenes)
    for axes, title in zip(panels, ("solved of all, %", "cost of solved problems"), strict=True):
        axes.tick_params(axis="x", rotation=30)
        for name in axes.get_xticklabels():
            name.set_ha("right")
        axes.set_title(title)
    figure.legend(*panels[1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def table(results: Row) -> str:
    """A line a scene and planner."""
    settings, machine = results["settings"], results["machine"]
    words = (
        f"{sum(settings['problems'].values())} problems of {settings['set']}.npz, "
        f"{settings['robot']}; a problem is valid if both ends are free. OMPL in "
        f"{settings['processes']} processes, at most {settings['time_limit']:g} s a problem; "
        f"{OWN} one problem at a time, but plans/s with all of a scene, or of all scenes, at once. "
        f"{made_on(machine)}.\n"
    )
    head = "scene,planner,problems,valid,solved of all %,of valid %,certified of all %".split(",")
    head += ["cost (mean)", "where guided solves, too", "configuration checks (median)"]
    head += ["total of a query, ms (median)", "95 %", "plans/s"]
    scenes = list(of_planner(results, OWN))
    order = (OWN, *RIVALS, *PUBLISHED)
    rows = sorted(
        results["rows"], key=lambda row: (scenes.index(row["scene"]), order.index(row["planner"]))
    )
    return f"{words}\n{markdown(head, [_line(row) for row in rows])}"


def _line(row: Row) -> list[str]:
    name = row["planner"]
    if name in PUBLISHED:
        costs = cell(row["cost"], ".2f"), _cost(row["cost_where_guided_solves"])
        begin = [row["scene"], label(name), str(row["num_problems"])]
        return [*begin, *["-"] * 4, *costs, *["-"] * 4]
    shares = (row["success_of_all"], row["success"], row["certified"])
    return [
        row["scene"],
        label(name),
        str(row["num_problems"]),
        str(row["num_accepted"]),
        *("-" if share is None else f"{100 * share:.1f}" for share in shares),
        cell(row["cost"], ".2f"),
        _cost(row["both"]["cost"]),
        cell(row["configuration_checks"], ".0f", key="median"),
        *(cell(row["total_time_s"], ".1f", 1e3, key) for key in ("median", "p95")),
        f"{row['per_s']:.1f}",
    ]


def _cost(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
