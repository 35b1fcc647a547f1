"""Summaries over problems and seeds, with 95 % intervals over problems: bootstrap intervals, and
those of shares."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gnnjax.measure.rows import QUANTITIES
from gnnjax.measure.statistics import describe

Rows = Sequence[Sequence[dict]]  # of `gnnjax.evaluate`, a list a seed

SHARES = ("success", "success_first_roadmap", "certified")
BAND = ("mean", "low", "high")

_RESAMPLES = 2000  # of the bootstrap


def summarize_seeds(per_seed: Rows, keep: Callable[[int], bool] = lambda index: True) -> dict:
    """Sums up the same problems planned with several seeds: all of them, and the hard ones.

    Intervals are 95 % bootstrap intervals over problems, each problem with all its seeds.

    Args:
        per_seed: rows of the same problems.
        keep: which problems count, by index.
    """
    valid = np.array([row["valid"] and keep(row["index"]) for row in per_seed[0]])
    hard = np.array([row["hard"] for row in per_seed[0]])
    summary: dict[str, Any] = {
        "num_problems": len(valid),
        "num_seeds": len(per_seed),
        "num_invalid": sum(not row["valid"] for row in per_seed[0]),
    }
    columns = {name: column(per_seed, _COLUMNS[name]) for name in _COLUMNS}
    for stratum, chosen in {"all": valid, "hard": valid & hard}.items():
        solved = columns["success"][:, chosen]
        part: dict[str, Any] = {"num_problems": int(chosen.sum())}
        for name, found in columns.items():
            values = found[:, chosen]
            counts = np.ones_like(solved) if QUANTITIES.get(name, True) else solved
            # NaN: a planner that has no such quantity.
            part[name] = statistics(values, counts.astype(bool) & ~np.isnan(values))
        summary[stratum] = part
    return summary


def solved_first(row: dict) -> bool:
    """Whether a problem was solved on its first roadmap."""
    return row["success"] and row["roadmaps"] == 1


def column(per_seed: Rows, of: Callable[[dict], Any]) -> np.ndarray:
    """A number of every row, `[seeds, problems]`; NaN for None."""
    values = [[of(row) for row in seed] for seed in per_seed]
    return np.array([[np.nan if v is None else float(v) for v in seed] for seed in values])


_COLUMNS: dict[str, Callable[[dict], Any]] = {
    name: solved_first if name == "success_first_roadmap" else lambda row, name=name: row[name]
    for name in (*SHARES, *QUANTITIES)
}


def statistics(values: np.ndarray, counts: np.ndarray) -> dict[str, float] | None:
    """Mean with its 95 % interval, spread, median and 95th percentile.

    Args:
        values: `[seeds, problems]`.
        counts: which of them count.
    """
    chosen = values[counts]
    if not chosen.size:
        return None
    sums = np.where(counts, values, 0.0).sum(axis=0)
    low, high = _interval(sums, counts.sum(axis=0))
    found = describe(chosen)
    return {"mean": found["mean"], "low": low, "high": high} | found


def proportion(count: float, of: float) -> dict[str, float] | None:
    """A share with its 95 % interval (Wilson)."""
    if not of:
        return None
    mean, z = count / of, 1.959964
    middle = mean + z**2 / (2 * of)
    spread = z * np.sqrt(mean * (1 - mean) / of + z**2 / (4 * of**2))
    low, high = ((middle + side * spread) / (1 + z**2 / of) for side in (-1, 1))
    return {"mean": mean, "low": float(low), "high": float(high)}


def ratio_of_means(ours: Rows, theirs: Rows, quantity: str) -> dict[str, float] | None:
    """Mean of a quantity over the mean of another planner's, on the same valid problems, with its
    95 % interval."""
    valid = np.array([row["valid"] for row in ours[0]])
    above, below = (
        column(rows, lambda row: row[quantity])[:, valid].sum(axis=0) for rows in (ours, theirs)
    )
    if not below.any():
        return None
    values = above.sum() / below.sum(), *_interval(above, below)
    return {name: float(value) for name, value in zip(BAND, values, strict=True)}


def _interval(above: np.ndarray, below: np.ndarray) -> tuple[float, float]:
    """95 % bootstrap interval of the ratio of two sums over problems."""
    num = len(above)
    rows = np.random.default_rng(0).integers(num, size=(_RESAMPLES, num))
    with np.errstate(divide="ignore", invalid="ignore"):  # a resample without a solved problem
        ratios = above[rows].sum(axis=1) / below[rows].sum(axis=1)
    low, high = np.quantile(ratios[np.isfinite(ratios)], [0.025, 0.975])
    return float(low), float(high)
