"""Markdown tables of summaries (of `experiments.statistics`), and words for numbers."""

from collections.abc import Callable, Iterable, Sequence

from experiments.results import Row
from experiments.style import label

SETS = {"test": "The project's own 300 test problems", "public": "The first 300 public problems"}


def cell(part: Row | None, form: str, scale: float = 1.0, key: str = "mean") -> str:
    """One number of a summary; a dash where there is none."""
    return "-" if part is None else f"{scale * part[key]:{form}}"


def interval(part: Row | None, form: str, scale: float = 1.0) -> str:
    """A mean with its 95 % interval."""
    if part is None:
        return "-"
    low, high = (f"{scale * part[key]:{form}}" for key in ("low", "high"))
    return f"{scale * part['mean']:{form}} ({low} to {high})"


def both(row: Row, write: Callable[[Row], str]) -> str:
    """A cell for all problems / the hard ones."""
    return " / ".join(write(row["summary"][stratum]) for stratum in ("all", "hard"))


# Title of a column, and what it holds for a stratum.
MAIN: tuple[tuple[str, Callable[[Row], str]], ...] = (
    ("solved, %", lambda part: cell(part["success"], ".1f", 100)),
    ("certified, %", lambda part: cell(part["certified"], ".1f", 100)),
    ("edge checks, mean", lambda part: cell(part["edge_checks"], ".1f")),
    ("configuration checks, mean", lambda part: cell(part["configuration_checks"], ".0f")),
    ("median", lambda part: cell(part["configuration_checks"], ".0f", key="median")),
    ("cost, mean", lambda part: cell(part["cost"], ".2f")),
    ("planning, ms", lambda part: cell(part["planning_time_s"], ".1f", 1e3, "median")),
    ("total, ms", lambda part: cell(part["total_time_s"], ".1f", 1e3, "median")),
)

DETAIL: tuple[tuple[str, Callable[[Row], str]], ...] = (
    ("solved, %", lambda part: interval(part["success"], ".1f", 100)),
    ("with one roadmap, %", lambda part: cell(part["success_first_roadmap"], ".1f", 100)),
    ("edge checks", lambda part: interval(part["edge_checks"], ".1f")),
    ("95th percentile", lambda part: cell(part["edge_checks"], ".0f", key="p95")),
    ("configuration checks", lambda part: interval(part["configuration_checks"], ".0f")),
    ("of them sampling", lambda part: cell(part["sampling_checks"], ".0f")),
    ("cost", lambda part: interval(part["cost"], ".2f")),
)


def markdown(head: list[str], lines: list[list[str]]) -> str:
    """A Markdown table."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def planner_table(rows: list[Row], columns=MAIN) -> str:
    """A row a planner and roadmap size, cells for all problems / the hard ones."""
    ordered = sorted(rows, key=lambda row: row["num_nodes"] or 0)
    lines = [
        [str(row["num_nodes"] or "-"), label(row["planner"])]
        + [both(row, write) for _, write in columns]
        for row in ordered
    ]
    return markdown(["N", "planner", *[title for title, _ in columns]], lines)


def seconds(value: float | None) -> str:
    """A price in a readable unit."""
    if value is None:
        return "never"
    if value <= 1.0001e-8:
        return "always"
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if value >= scale:
            return f"{value / scale:.3g} {unit}"
    return f"{value:.3g} s"


def measured_on(results: Row, row: Row) -> str:
    """Problems, seeds and machine, in a sentence."""
    summary, machine = row["summary"], results["machine"]
    num = summary["num_problems"]
    return (
        f"{num} problems, {num - summary['num_invalid']} of them valid "
        f"({summary['num_invalid']} have an end in collision) and "
        f"{summary['hard']['num_problems']} hard; {summary['num_seeds']} seeds. "
        f"{made_on(machine)}."
    )


def made_on(machine: Row) -> str:
    """Where results come from: processor, cores that the process could use, and versions."""
    num = machine["cores"]
    cores = "1 core" if num == 1 else f"{num} cores"
    return f"{machine['processor']}, {cores}, jax {machine['jax']}, gnnjax {machine['gnnjax']}"


def span(values: Iterable[float], form: str, scale: float = 1) -> str:
    """The least to the largest of some numbers, or the one that they round to."""
    ordered = sorted(values)
    ends = dict.fromkeys(f"{scale * value:{form}}" for value in (ordered[0], ordered[-1]))
    return " to ".join(ends)


def listing(words: Sequence[str]) -> str:
    """Words with commas between them and an "and" before the last."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
