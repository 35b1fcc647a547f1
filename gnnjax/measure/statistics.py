"""Results of many problems, summed up."""

from typing import Any

import numpy as np

from gnnjax.measure.rows import QUANTITIES


def summarize(rows: list[dict]) -> dict[str, Any]:
    """Mean, spread and median of each quantity, over all valid problems and over the hard ones.

    The cost is over solved problems; everything else over all. `certified` is the share with a path
    that is proven free, which some planners find out only afterwards.
    """
    valid = [row for row in rows if row["valid"]]
    strata = {"all": valid, "hard": [row for row in valid if row["hard"]]}
    summary: dict[str, Any] = {
        "num_problems": len(rows),
        "num_invalid": len(rows) - len(valid),
        "invalid_problems": [row["index"] for row in rows if not row["valid"]],
    }
    for stratum, chosen in strata.items():
        num = len(chosen)
        solved = [row for row in chosen if row["success"]]
        first = [row for row in solved if row["roadmaps"] == 1]
        part: dict[str, Any] = {
            "num_problems": num,
            "success": len(solved) / num if num else None,
            "certified": sum(row["certified"] for row in chosen) / num if num else None,
            "success_first_roadmap": len(first) / num if num else None,
        }
        for name, failures_count in QUANTITIES.items():
            rows_counted = chosen if failures_count else solved
            values = [row[name] for row in rows_counted if row[name] is not None]
            part[name] = describe(np.array(values)) if values else None
        summary[stratum] = part
    return summary


def describe(values: np.ndarray) -> dict[str, float]:
    """Mean, spread, median and 95th percentile of the values there are."""
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "median": float(np.median(values)),
        "p95": float(np.quantile(values, 0.95)),
    }
