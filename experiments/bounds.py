"""How near a planner's checks come to what no planner can do without: checking its own path.

An edge of the returned path has to be checked, and so have the configurations along it. What a
planner checks beside these is the price of not knowing the path beforehand.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from experiments.measure import statistics

Rows = Sequence[Sequence[dict]]  # of `gnnjax.evaluate`, a list a seed


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
    hard = _table(found, lambda row: row["valid"] and row["hard"]).astype(bool)
    own, theirs, there, best = (
        hard & _table(rows, _on_first).astype(bool) for rows in (found, guided, shortest, optimal)
    )
    checks = _table(found, lambda row: row["edge_checks"])
    edges = _table(found, _edges)
    costs = [_table(rows, lambda row: row["cost"] or np.nan) for rows in (found, optimal)]
    with np.errstate(divide="ignore", invalid="ignore"):  # rows that do not count
        return {
            "edges": statistics(edges, own),
            "per_edge": statistics(checks / edges, own),
            "share": statistics(own.astype(float), there),
            "per_guided_edge": statistics(checks / _table(guided, _edges), own & theirs),
            "per_shortest_edge": statistics(checks / _table(shortest, _edges), there),
            "cost_ratio": statistics(costs[0] / costs[1], own & best),
        }


def per_verification(found: Rows, resolution: float) -> dict[str, dict[str, Any] | None]:
    """Configuration checks over those that testing the returned path alone would take, which are
    its cost / resolution: statistics over solved problems, all and the hard ones."""
    solved = _table(found, lambda row: row["success"]).astype(bool)
    hard = _table(found, lambda row: row["hard"]).astype(bool)
    cost = _table(found, lambda row: row["cost"] or np.nan)
    ratio = _table(found, lambda row: row["configuration_checks"]) * resolution / cost
    return {"all": statistics(ratio, solved), "hard": statistics(ratio, solved & hard)}


def _table(rows: Rows, of: Callable[[dict], Any]) -> np.ndarray:
    return np.array([[float(of(row)) for row in seed] for seed in rows])


def _on_first(row: dict) -> bool:
    return row["success"] and row["roadmaps"] == 1


def _edges(row: dict) -> int:
    return max(0, len(row["path"]) - 1)
