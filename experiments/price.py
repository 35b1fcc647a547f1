"""What planners would need if a configuration check had a price, and where that decides."""

import dataclasses
from typing import Any

import numpy as np

from experiments.statistics import BAND, statistics
from gnnjax.planning.options import CHEAP

GUIDES = ("guided", "gnn", "gnn_lazy")

# Seconds a configuration check may cost: a grid for the curves, and a fine one for crossovers.
DEARNESS = np.geomspace(1e-8, 1e-1, 36)
FINE = np.geomspace(1e-8, 1e-1, 701)


@dataclasses.dataclass(frozen=True)
class Timed:
    """What a planner needed for P problems with S seeds."""

    key: dict[str, Any]  # set, planner, num_nodes, and whether it is the bound without overhead
    command: str
    time: np.ndarray  # [S, P] s
    checks: np.ndarray  # [S, P]
    solved: np.ndarray  # [S, P]
    strata: dict[str, np.ndarray]  # [P] which problems belong to "all" and "hard"
    dear: "Timed | None" = (
        None  # the same planner, told that checks are dear, where that changes it
    )


def without_overhead(timed: Timed) -> Timed:
    """The bound: as if a planner did nothing but check."""
    return dataclasses.replace(
        timed, key=timed.key | {"bound": True}, time=np.zeros_like(timed.time)
    )


def total_times(timed: Timed, stratum: str, check_s: np.ndarray) -> np.ndarray:
    """Total times `[C, S, P']` in s of a stratum's problems, a configuration check costing
    `check_s` `[C]`, which a planner is told."""
    chosen, price = timed.strata[stratum], check_s[:, None, None]
    total = timed.time[:, chosen] + price * timed.checks[:, chosen]
    if timed.dear is None:
        return total
    return np.where(price * 1e6 > CHEAP, total_times(timed.dear, stratum, check_s), total)


def crossovers(timed: list[Timed]) -> list[dict[str, Any]]:
    """From where on each guide is faster than each other planner of the same set and size, and what
    it saves in the mean at the highest price."""
    averaged = [averages(t) for t in timed]
    found = []
    for guide, ours in zip(timed, averaged, strict=True):
        for rival, theirs in zip(timed, averaged, strict=True):
            sizes = guide.key["num_nodes"], rival.key["num_nodes"]
            same = rival.key["set"] == guide.key["set"] and sizes[1] in (None, sizes[0])
            if guide.key["planner"] not in GUIDES or rival is guide or not same:
                continue
            key = {"set": guide.key["set"], "guide": guide.key["planner"], "num_nodes": sizes[0]}
            key |= {"rival": rival.key["planner"], "bound": rival.key["bound"]}
            for (stratum, average), times in ours.items():
                where = faster(FINE, times, theirs[stratum, average])
                where["saved_s"] = saved(guide, rival, stratum)
                found.append(key | {"stratum": stratum, "average": average} | where)
    return found


def saved(guide: Timed, rival: Timed, stratum: str) -> dict[str, float] | None:
    """Mean of what a guide saves on each problem at the highest price, s, with its interval."""
    ours, theirs = (total_times(t, stratum, FINE[-1:])[0] for t in (guide, rival))
    found = statistics(theirs - ours, np.ones(ours.shape, bool))
    return None if found is None else {name: found[name] for name in BAND}


def averages(timed: Timed) -> dict[tuple[str, str], np.ndarray]:
    """Mean and median total times `[C]` over FINE, of each stratum that has problems."""
    return {
        (stratum, average.__name__): average(total_times(timed, stratum, FINE), axis=(1, 2))
        for stratum, chosen in timed.strata.items()
        if chosen.any()
        for average in (np.mean, np.median)
    }


def faster(check_s: np.ndarray, ours: np.ndarray, theirs: np.ndarray) -> dict[str, Any]:
    """Where we are faster.

    Returns:
        `from_s`, the price of a check from which on we are faster at every higher one of
        `check_s` (None: not even at the highest; the lowest of all: everywhere), and
        `intervals_s`, all intervals where we are.
    """
    wins = np.concatenate([[False], ours < theirs, [False]]).astype(int)
    begins, ends = np.flatnonzero(np.diff(wins) == 1), np.flatnonzero(np.diff(wins) == -1) - 1
    intervals = [[float(check_s[a]), float(check_s[b])] for a, b in zip(begins, ends, strict=True)]
    dearest = bool(intervals) and intervals[-1][1] == check_s[-1]
    return {"from_s": intervals[-1][0] if dearest else None, "intervals_s": intervals}
