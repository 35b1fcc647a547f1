"""What is measured of motions that an arm carries out.

A joint swings if it turns back three times or more, small movements left out. Out of one place and
into another it may have to turn back twice: to retreat first, and to go past the goal and come
back. Whoever turns back once more does again what was done before.
"""

from typing import Any

import numpy as np

from experiments.results import Row
from experiments.statistics import proportion
from gnnjax.measure.statistics import describe
from gnnjax.trajectory.execution import Execution

_SMALL = 0.05  # rad, of a movement that is none
_SWINGS = 3  # times that a joint turns back


def told(found: Execution) -> dict[str, Any]:
    """What is kept of an execution: a row, of which `summarize` makes one of many."""
    turns = turnings(found.trace.positions)
    return {
        "reason": found.reason,
        "touched": bool(found.touched),
        "settled": found.settled,
        "swings": bool(turns.max() >= _SWINGS),
        "suitable": bool(found.success and turns.max() < _SWINGS),
        "proven": found.proven,
        "turns": int(turns.sum()),
        "duration": found.duration,
        "max_error": float(found.max_error.max()),
        "tip_error": found.tip_error,
        "stray": found.stray,
        "torque_use": found.torque_use,
    }


def turnings(positions: np.ndarray, small: float = _SMALL) -> np.ndarray:
    """How often each joint turns back along positions `[T D]`, `[D]`; movements of less than
    `small` are none."""
    counts = np.zeros(positions.shape[1], int)
    for joint, values in enumerate(positions.T):
        low = high = values[0]
        heading = 0
        for value in values:
            low, high = min(low, value), max(high, value)
            back = value < high - small if heading >= 0 else value > low + small
            if heading == 0 and value > low + small:
                heading = 1
            elif back:
                counts[joint] += heading != 0
                heading = -1 if heading >= 0 else 1
            else:
                continue
            low = high = value
    return counts


COUNTS = ("accepted", "found", "timed", "touched", "settled", "swings", "suitable", "proven")
_MEASURED = ("turns", "duration", "max_error", "tip_error", "stray", "torque_use")


def summarize(rows: list[dict[str, Any]]) -> Row:
    """Counts of problems, the share of accepted ones whose motion is suitable, and what was
    measured of motions."""
    counts = {name: sum(bool(row.get(name)) for row in rows) for name in COUNTS}
    timed = [row for row in rows if row["timed"]]
    measured = {
        name: describe(np.array([row[name] for row in timed])) if timed else None
        for name in _MEASURED
    }
    share = proportion(counts["suitable"], counts["accepted"])
    return {"num_problems": len(rows), **counts, "suitable_share": share, **measured}
