"""Results of many problems, summed up."""

from typing import Any

import numpy as np

from gnnjax.measure.rows import QUANTITIES


def columns_of(rows: list[dict]) -> dict[str, np.ndarray]:
    """What is summed up of rows, `[R]` each; NaN where a quantity is None."""
    kinds = dict.fromkeys(("valid", "hard", "success", "certified"), bool)
    kinds |= {"index": int, "roadmaps": int} | dict.fromkeys(QUANTITIES, float)
    return {name: np.array([row[name] for row in rows], kind) for name, kind in kinds.items()}


def summarize(rows: list[dict]) -> dict[str, Any]:
    """Mean, spread and median of each quantity, over all valid problems and over the hard ones.

    The cost is over solved problems; everything else over all. `certified` is the share with a path
    that is proven free, which some planners find out only afterwards.
    """
    return summarize_columns(columns_of(rows))


def summarize_columns(columns: dict[str, np.ndarray]) -> dict[str, Any]:
    """See `summarize`; of more rows than fit into memory as such."""
    valid = columns["valid"]
    summary: dict[str, Any] = {
        "num_problems": len(valid),
        "num_invalid": int((~valid).sum()),
        "invalid_problems": columns["index"][~valid].tolist(),
    }
    for stratum, chosen in {"all": valid, "hard": valid & columns["hard"]}.items():
        num = int(chosen.sum())
        solved = chosen & columns["success"]
        first = solved & (columns["roadmaps"] == 1)
        shares = {
            "success": solved,
            "certified": chosen & columns["certified"],
            "success_first_roadmap": first,
        }
        part: dict[str, Any] = {"num_problems": num}
        part |= {name: int(x.sum()) / num if num else None for name, x in shares.items()}
        for name, failures_count in QUANTITIES.items():
            values = columns[name][chosen if failures_count else solved]
            values = values[~np.isnan(values)]
            part[name] = describe(values) if len(values) else None
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
