"""The README's tables: every planner on the test problems and the public ones, N = 200 to 1000.

    python -m gnnjax.generate --split test
    python -m experiments.convert_public kukas_7_3000.pkl data/kuka_iiwa14_public.npz
    python -m experiments.main_table

Runs `gnnjax.evaluate` for each row (rows that are done are kept), writes the summaries to
`results/main_table.json` and puts the tables into the README. `--only-text` skips the runs.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, get_args

import tyro

from gnnjax.errors import InputError, atomic_write, run_command
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.planner import Method

RESULTS = Path("results/main_table.json")
README = Path("README.md")

SETS = {
    "test": Path("data/kuka_iiwa14_test.npz"),
    "public": Path("data/kuka_iiwa14_public.npz"),
}


@dataclasses.dataclass(frozen=True)
class TableConfig:
    """Evaluate every planner and write the README's tables."""

    robot: str = "kuka_iiwa14"
    """The arm of the problems."""
    planners: tuple[str, ...] = get_args(Method)
    """Rows of the tables."""
    num_nodes: tuple[int, ...] = (200, 400, 600, 800, 1000)
    """Roadmap sizes."""
    num_problems: int = 300
    """The first so many of each set."""
    runs: Path = Path("runs/main_table")
    """Where the results of each row go, problem by problem."""
    only_text: bool = False
    """Only write the README's tables from the summaries there are."""


def run(config: TableConfig) -> None:
    """Evaluates what is missing and writes summaries and tables."""
    rows = _read_rows()
    for name, path in () if config.only_text else SETS.items():
        for planner in config.planners:
            for num_nodes in config.num_nodes:
                out = config.runs / f"{name}_{planner}_{num_nodes}.json"
                settings = EvaluateConfig(
                    problems=path,
                    json=out,
                    robot=config.robot,
                    planner=planner,
                    num_nodes=num_nodes,
                    num_problems=config.num_problems,
                )
                print(f"{name}, {planner}, {num_nodes} nodes")
                results = evaluate(settings)
                key = {"set": name, "planner": planner, "num_nodes": num_nodes}
                rows = [row for row in rows if any(row[k] != v for k, v in key.items())]
                rows.append({**key, "command": _command(settings)} | _without_problems(results))
                _write_rows(rows)
    text = README.read_text(encoding="utf-8")
    for name in SETS:
        text = replace_section(text, f"table-{name}", table(_read_rows(), name))
    atomic_write(README, lambda file: file.write_text(text, encoding="utf-8"))
    print(f"wrote {RESULTS} and the tables of {README}")


def _without_problems(results: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in results.items() if name != "problems"}


def _command(config: EvaluateConfig) -> str:
    return (
        f"python -m gnnjax.evaluate --problems {config.problems} --planner {config.planner} "
        f"--num-nodes {config.num_nodes} --num-problems {config.num_problems} --json out.json"
    )


def _read_rows() -> list[dict[str, Any]]:
    return json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else []


def _write_rows(rows: list[dict[str, Any]]) -> None:
    rows = sorted(rows, key=lambda r: (r["set"], r["num_nodes"], r["planner"]))
    text = json.dumps(rows, indent=1) + "\n"
    atomic_write(RESULTS, lambda file: file.write_text(text, encoding="utf-8"))


def table(rows: list[dict[str, Any]], name: str) -> str:
    """One problem set as a Markdown table: all problems / hard ones."""
    chosen = [row for row in rows if row["set"] == name]
    if not chosen:
        return "Not measured yet.\n"
    order = {planner: i for i, planner in enumerate(get_args(Method))}
    chosen.sort(key=lambda row: (row["num_nodes"], order.get(row["planner"], len(order))))
    lines = [
        "| N | planner | solved, % | with one roadmap, % | edge checks, mean | median "
        "| configuration checks, mean | cost, mean | planning, ms | total, ms |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in chosen:
        strata = [row["summary"]["all"], row["summary"]["hard"]]

        def both(form: str, *keys: str, scale: float = 1.0, strata: list = strata) -> str:
            values = []
            for value in strata:
                for key in keys:
                    value = None if value is None else value[key]  # None: no such problem
                values.append("-" if value is None else f"{scale * value:{form}}")
            return " / ".join(values)

        cells = [
            str(row["num_nodes"]),
            row["planner"],
            both(".1f", "success", scale=100),
            both(".1f", "success_first_roadmap", scale=100),
            both(".1f", "edge_checks", "mean"),
            both(".0f", "edge_checks", "median"),
            both(".0f", "configuration_checks", "mean"),
            both(".2f", "cost", "mean"),
            both(".1f", "planning_time_s", "median", scale=1e3),
            both(".1f", "total_time_s", "median", scale=1e3),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    machine, summary = chosen[0]["machine"], chosen[0]["summary"]
    invalid = summary["num_invalid"]
    lines += [
        "",
        f"{summary['num_problems']} problems, {summary['all']['num_problems']} of them valid "
        f"({invalid} have an end in collision) and {summary['hard']['num_problems']} hard. "
        f"{machine['processor']}, {machine['cores']} cores, jax {machine['jax']}. A row is made by",
        "",
        "```sh",
        chosen[0]["command"],
        "```",
        "",
    ]
    return "\n".join(lines)


def replace_section(text: str, name: str, content: str) -> str:
    """Replaces what is between the comments `<!-- name -->` and `<!-- /name -->`."""
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    if begin not in text or end not in text:
        raise InputError(f"{README} lacks the comments {begin.strip()} and {end}; add them")
    head, rest = text.split(begin, 1)
    return head + begin + content + end + rest.split(end, 1)[1]


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(TableConfig)))
