"""Files of results, `results/NAME.json`: written as the rows come, read, and looked up."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gnnjax.errors import InputError
from gnnjax.files import atomic_write
from gnnjax.measure.machine import describe_machine

# Of the files in `results/`; raised when what they hold changes its meaning.
FORMAT = 1

# Planners that search no roadmaps, of which files of Figure 5 from earlier versions tell sizes.
_WITHOUT_ROADMAPS = ("guided", "guided@0.02")

Row = dict[str, Any]


def save_results(path: Path, claim: str, rows: Iterable[Row], head: Mapping[str, Any]) -> Row:
    """Writes a file anew after every row, as they come, and returns what it holds.

    Args:
        path: of the file, named after the experiment.
        claim: what it tests.
        rows: made one after the other.
        head: further entries of the file.
    """
    about = {"format": FORMAT, "experiment": path.stem, "claim": claim}
    results = {**about, "machine": describe_machine(), **head, "rows": []}
    begin = json.dumps({k: v for k, v in results.items() if k != "rows"}, allow_nan=False)[:-1]
    for row in rows:
        results["rows"].append(row)
        # A line a row, so that a change shows which rows changed.
        lines = ",\n".join(json.dumps(each, allow_nan=False) for each in results["rows"])
        text = f'{begin}, "rows": [\n{lines}\n]}}\n'
        atomic_write(path, lambda file, text=text: file.write_text(text, encoding="utf-8"))
    return results


def load_results(path: Path) -> Row:
    """Reads a file of `save_results`.

    Raises:
        InputError: no such file, or one of another format.
    """
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
        found = results["format"]
    except FileNotFoundError:
        raise InputError(f"no results {str(path)!r}; run python -m experiments.run_all") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{str(path)!r} holds no results; remove it and run again") from None
    if found != FORMAT:
        raise InputError(
            f"{str(path)!r} holds results of format {found!r}, this version reads {FORMAT}; "
            "remove it and run again"
        )
    if results.get("experiment") == "figure5":
        results["rows"] = _without_sizes(results["rows"])
    return results


def _without_sizes(rows: list[Row]) -> list[Row]:
    """The rows, but of planners that search no roadmaps the first alone, without a size."""
    found: dict[tuple, Row] = {}
    for row in rows:
        size = None if row["planner"] in _WITHOUT_ROADMAPS else row["num_nodes"]
        found.setdefault((row["set"], row["planner"], size), row | {"num_nodes": size})
    return list(found.values())


def of_set(results: Row, name: str) -> list[Row]:
    """The rows of one problem set."""
    return [row for row in results["rows"] if row["set"] == name]


class Measured:
    """Looks up what planners needed in the rows of one problem set."""

    def __init__(self, rows: list[Row]):
        self.rows = rows
        self.sizes = sorted({row["num_nodes"] for row in rows if row["num_nodes"]})

    def sizes_of(self, planner: str) -> list[int]:
        """Roadmap sizes that a planner was measured with; none for planners without roadmaps."""
        sizes = {row["num_nodes"] for row in self.rows if row["planner"] == planner}
        return sorted(sizes - {None})

    def each(
        self, planner: str, quantity: str, *, stratum: str = "all", key: str = "mean"
    ) -> list[float]:
        """A summary's number for every roadmap size that the planner was measured with."""
        return [
            self.mean(planner, quantity, num_nodes=size, stratum=stratum, key=key)
            for size in self.sizes_of(planner) or [None]
        ]

    def mean(
        self,
        planner: str,
        quantity: str,
        *,
        num_nodes: int | None = None,
        stratum: str = "all",
        key: str = "mean",
    ) -> float:
        """A summary's number, averaged over the roadmap sizes unless one is named."""
        values = [
            row["summary"][stratum][quantity][key]
            for row in self.rows
            if row["planner"] == planner and num_nodes in (None, row["num_nodes"])
        ]
        if not values:
            raise KeyError(f"{planner} with {num_nodes} nodes was not measured")
        return float(np.mean(values))

    def ratio(self, planner: str, other: str, quantity: str, **where: Any) -> float:
        """One planner's mean over another's."""
        return self.mean(planner, quantity, **where) / self.mean(other, quantity, **where)
