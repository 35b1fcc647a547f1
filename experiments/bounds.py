"""How near a planner's checks come to what no planner can do without: checking its own path.

An edge of the returned path has to be checked, and so have the configurations along it. What a
planner checks beside these is the price of not knowing the path beforehand.
"""

from typing import Any

import numpy as np

from experiments.results import Row
from experiments.statistics import Rows, column, solved_first, statistics
from experiments.style import label
from experiments.tables import cell, interval, markdown

# On the same roadmaps: how many edges they check for each edge of the path.
BOUNDED = ("guided_sampled", "gnn_lazy", "lazysp", "gnn", "distance", "oracle")


def first_roadmap(found: Rows, guided: Rows, shortest: Rows, optimal: Rows) -> dict[str, Any]:
    """Edge checks per edge of the path, on hard problems whose first roadmap holds a path.

    Args:
        found: rows of a planner.
        guided: rows of the guided search on the same roadmaps.
        shortest: rows of LazySP, which finds a path wherever a roadmap has one.
        optimal: rows of PRM, whose paths are the roadmaps' shortest.

    Returns:
        Statistics. `edges`, `per_edge` and `cost_ratio` (to PRM's) are of problems that the planner
        solves on its first roadmap, each by the edges of its own path; `share` says how many of the
        roadmaps that hold a path these are. `per_guided_edge` is by the edges of the guided
        search's path, where both come from the first roadmap. `per_shortest_edge` is of all
        problems whose first roadmap holds a path, found there or not, by the edges of LazySP's.
    """
    hard = column(found, lambda row: row["valid"] and row["hard"]).astype(bool)
    own, theirs, there, best = (
        hard & column(rows, solved_first).astype(bool)
        for rows in (found, guided, shortest, optimal)
    )
    checks = column(found, lambda row: row["edge_checks"])
    edges = column(found, _edges)
    costs = [column(rows, lambda row: row["cost"]) for rows in (found, optimal)]
    with np.errstate(divide="ignore", invalid="ignore"):  # rows that do not count
        return {
            "edges": statistics(edges, own),
            "per_edge": statistics(checks / edges, own),
            "share": statistics(own.astype(float), there),
            "per_guided_edge": statistics(checks / column(guided, _edges), own & theirs),
            "per_shortest_edge": statistics(checks / column(shortest, _edges), there),
            "cost_ratio": statistics(costs[0] / costs[1], own & best),
        }


def per_verification(found: Rows, resolution: float) -> dict[str, dict[str, Any] | None]:
    """Configuration checks over those that testing the returned path alone would take, which are
    its cost / resolution: statistics over solved problems, all and the hard ones."""
    solved = column(found, lambda row: row["success"]).astype(bool)
    hard = column(found, lambda row: row["hard"]).astype(bool)
    cost = column(found, lambda row: row["cost"])
    ratio = column(found, lambda row: row["configuration_checks"]) * resolution / cost
    return {"all": statistics(ratio, solved), "hard": statistics(ratio, solved & hard)}


def _edges(row: dict) -> int:
    return max(0, len(row["path"]) - 1)


BOUNDS_NOTE = """Hard problems whose first roadmap holds a path. "Found in it": the share of them
that the planner solves on that roadmap, and of which its edges, checks and cost are shown. Cells:
mean (95 % interval), 95th percentile. No search can do with less than one check an edge of its
path. "All" are also those where the planner found no path in that roadmap, and went on to others.
"""

VERIFICATION_NOTE = """Of solved problems, all / hard: configuration checks, sampling included, over
cost / resolution, which is what testing the returned path takes.
"""


def bounds_table(rows: list[Row]) -> str:
    """Edge checks per edge of the path, hard problems whose first roadmap holds one."""

    def ratio(part: Row | None) -> str:
        return f"{interval(part, '.2f')}, {cell(part, '.1f', key='p95')}"

    lines = []
    for num_nodes in sorted({row["num_nodes"] for row in rows if row["num_nodes"]}):
        found = {row["planner"]: row for row in rows if row["num_nodes"] == num_nodes}
        for planner in BOUNDED:
            if planner not in found or "first_roadmap" not in found[planner]:
                continue  # not compared at this size
            part = found[planner]["first_roadmap"]
            lines.append(
                [str(num_nodes), label(planner)]
                + [cell(part["share"], ".1f", 100), cell(part["edges"], ".2f")]
                + [ratio(part[f"per_{kind}edge"]) for kind in ("", "guided_", "shortest_")]
                + [interval(part["cost_ratio"], ".3f")]
            )
    head = ["N", "planner", "found in it, %", "edges of the path", "checks an edge"]
    head += ["an edge of the guided path", "an edge of LazySP's, all", "cost over PRM's"]
    return markdown(head, lines)


def verification_table(rows: list[Row]) -> str:
    """Configuration checks over those of the returned path alone."""
    lines = []
    for row in rows:
        shown = row["planner"].startswith(("guided", "ompl:rrt_connect"))
        if shown and "per_verification" in row:
            parts = [row["per_verification"][stratum] for stratum in ("all", "hard")]
            line = [str(row["num_nodes"] or "-"), label(row["planner"])]
            line += [" / ".join(cell(part, ".2f", key="median") for part in parts)]
            line += [" / ".join(cell(part, ".2f") for part in parts)]
            lines.append(line)
    return markdown(["N", "planner", "median", "mean"], lines)
