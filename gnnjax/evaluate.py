"""Plans all problems of a set and sums up: success, checks, times and costs.

    python -m gnnjax.evaluate --problems data/kuka_iiwa14_test.npz --json guided.json

A path that comes after the time limit is a failure, whatever the planner.

Results are written as they come; the same command goes on where it was cut off.
"""

import contextlib
import dataclasses
import importlib.metadata
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.bounds import compile_certificates
from gnnjax.errors import InputError, brief, check_seed, is_out_of_memory, run_command
from gnnjax.files import atomic_write, check_target, locked
from gnnjax.measure.machine import describe_machine
from gnnjax.measure.rows import ROW, make_row, straight_line_blocked, within
from gnnjax.measure.statistics import summarize
from gnnjax.measure.table import print_summary
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.planner import Planner
from gnnjax.planning.processes import LEAST_SHARE, PlannerProcesses
from gnnjax.planning.query import Plan, QueryPlanner, check_queries
from gnnjax.problems.problem import ProblemSet
from gnnjax.problems.shards import load_problems
from gnnjax.scene.holding import attach_from_json

# Of the result files; raised when what they hold changes its meaning.
FORMAT = 2

_WRITE_EVERY_S = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateConfig(PlannerOptions):
    """Plan every problem of a set and write results and a summary as JSON."""

    problems: Path
    """An .npz of problems, or a folder of shards."""
    json: Path
    """Where results go; goes on with what is there if it has the same settings."""
    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF."""
    attach: Path | None = None
    """JSON file with what the arm holds, as for gnnjax.plan."""
    num_problems: int | None = None
    """Only the first so many problems."""
    batch_size: int = 1
    """Problems planned at once, fewer where memory does not suffice. With 1, times are those of
    single queries; with more, the shares of each problem in its batch."""
    processes: int = 1
    """Processes that share each batch, each on a core of its own; not for OMPL's planners."""
    time_limit: float = 5.0
    """Seconds a problem may take; a path that comes later is a failure."""
    seed: int = 0
    """Of the roadmaps, or of OMPL's random numbers."""


def evaluate(config: EvaluateConfig, planner: QueryPlanner | None = None) -> dict[str, Any]:
    """Plans what is missing of a set's results, and returns them all as they are in the file.

    Args:
        config: what to plan, and how.
        planner: of these options, for callers that evaluate several sets or seeds with one.
    """
    if config.batch_size < 1 or (config.num_problems is not None and config.num_problems < 1):
        raise InputError(
            f"batch_size is {config.batch_size}, num_problems {config.num_problems}; "
            "both must be at least 1"
        )
    _check_processes(config)
    check_seed(config.seed)
    check_target(config.json)
    planner = planner or make_planner(_arm(config), config)
    problems = load_problems(config.problems, planner.robot).take(slice(config.num_problems))
    settings = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    del settings["json"]
    settings |= {"num_problems": len(problems), "radius": planner.radius}
    with locked(config.json), _in_processes(planner, config) as planner:
        return _evaluate(planner, problems, settings, config)


def _in_processes(
    planner: QueryPlanner, config: EvaluateConfig
) -> contextlib.AbstractContextManager[QueryPlanner]:
    """The planner, in so many processes as are wanted."""
    if config.processes == 1:
        return contextlib.nullcontext(planner)
    assert isinstance(planner, Planner)  # OMPL's is none
    return PlannerProcesses(planner, config.processes)


def _check_processes(config: EvaluateConfig) -> None:
    num = config.processes
    if num != 1 and config.is_classical:
        raise InputError(f"processes is {num} with planner {config.planner!r}; it takes 1")
    if num < 1 or (num > 1 and config.batch_size < num * LEAST_SHARE):
        raise InputError(
            f"processes is {num} with batch_size {config.batch_size}; they share out a batch, "
            f"which needs at least {LEAST_SHARE} problems for each of them"
        )


def _arm(config: EvaluateConfig) -> Robot:
    robot = load_robot(config.robot)
    return robot if config.attach is None else attach_from_json(robot, config.attach)


def _evaluate(
    planner: QueryPlanner, problems: ProblemSet, settings: dict[str, Any], config: EvaluateConfig
) -> dict[str, Any]:
    results = {
        "format": FORMAT,
        "complete": False,
        "settings": settings,
        "machine": describe_machine() | _ompl(config),
        "summary": {},
        "problems": _earlier_results(config.json, settings),
    }
    if len(results["problems"]) < len(problems):
        # Seen now rather than after the first problems: a path that cannot be written.
        _write(config.json, results)
        _plan_missing(planner, problems, results, config)
    results["summary"], results["complete"] = summarize(results["problems"]), True
    _write(config.json, results)
    return results


def _ompl(config: EvaluateConfig) -> dict[str, str]:
    """The version of OMPL, where it plans."""
    return {"ompl": importlib.metadata.version("ompl")} if config.is_classical else {}


def _plan_missing(
    planner: QueryPlanner,
    problems: ProblemSet,
    results: dict[str, Any],
    config: EvaluateConfig,
) -> None:
    """Adds the rows that are missing, a batch at a time.

    No result depends on who else is in its batch: batches may begin at any row, where a run was cut
    off, and may become smaller.
    """
    rows, asked = results["problems"], problems.problems
    num = len(problems)
    size = min(config.batch_size, num - len(rows))
    compiled = stored = False
    planned, spent = 0, 0.0
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, TimeRemainingColumn()) as progress:
        task = progress.add_task("compiling", total=num, completed=len(rows))
        progress.console.print("compiling; the first time that takes up to a minute")
        compile_certificates(planner.robot)
        blocked = straight_line_blocked(planner.robot, config.checker, asked)
        written = time.monotonic()
        while len(rows) < num:
            batch = np.arange(len(rows), min(len(rows) + size, num))
            begin = time.perf_counter()
            reasons = check_queries(planner.robot, _take(asked, batch), config.margin)
            checking = time.perf_counter() - begin
            valid = batch[[reason is None for reason in reasons]]
            plans: dict[int, Plan] = {}
            try:
                if not compiled:
                    planner.warm_up(_take(asked.scene, 0), size)
                    compiled = True
                if len(valid):
                    # Whole batches, so that nothing is compiled again.
                    queries = _take(asked, np.resize(valid, size))
                    if not stored:  # the roadmaps of this seed are, from now on
                        planner.plan_batch(queries, seed=config.seed)
                        stored = True
                    begin = time.perf_counter()
                    made = planner.plan_batch(queries, seed=config.seed)
                    checked_and_planned = checking + time.perf_counter() - begin
                    plans = dict(zip(valid.tolist(), made, strict=False))
                    planned, spent = planned + len(valid), spent + checked_and_planned
            except (MemoryError, jax.errors.JaxRuntimeError) as error:
                smaller = _halved(size, error)
                progress.console.print(
                    f"not enough memory for {size} problems at once; batch_size is halved to "
                    f"{smaller}"
                )
                size, compiled = smaller, False
                continue
            for i, reason in zip(batch.tolist(), reasons, strict=True):
                share = checking / len(batch)
                row = make_row(i, plans.get(i), reason or "", bool(blocked[i]), share)
                rows.append(within(row, config.time_limit))
            words = f"{config.planner}, {planned / spent:.3g} problems/s" if planned else "planning"
            progress.update(task, completed=len(rows), description=words)
            if time.monotonic() - written > _WRITE_EVERY_S:
                _write(config.json, results)
                written = time.monotonic()


def _take(problems: Any, rows: np.ndarray | int) -> Any:
    return jax.tree.map(lambda x: x[rows], problems)


def _halved(size: int, error: Exception) -> int:
    """Half the size of a batch that did not fit into memory; other errors go on."""
    if not is_out_of_memory(error):
        raise error
    if size == 1:
        raise InputError(f"not enough memory for one problem; ask for fewer nodes ({error})")
    return size // 2


def _earlier_results(path: Path, settings: dict[str, Any]) -> list[dict]:
    """The problems that an earlier run with the same settings has in its file."""
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        version, theirs = earlier["format"], dict(earlier["settings"])
        rows = list(earlier["problems"])
        if version == FORMAT:
            _check_rows(rows)
    except FileNotFoundError:
        return []
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(
            f"{str(path)!r} exists and holds no results; remove it, or choose another --json"
        ) from None
    if version != FORMAT:
        raise InputError(
            f"{str(path)!r} holds results of format {brief(version)}, this version writes "
            f"{FORMAT}; choose another --json"
        )
    # A file from before an option was there has none of it, which is what its default says.
    fields = dataclasses.fields(EvaluateConfig)
    theirs = {f.name: f.default for f in fields if f.default is not dataclasses.MISSING} | theirs
    for name, value in settings.items():
        if theirs.get(name) != value:
            raise InputError(
                f"{str(path)!r} holds results with {name} {brief(theirs.get(name))}, not "
                f"{brief(value)}; "
                "choose another --json"
            )
    return rows


def _check_rows(rows: list[dict]) -> None:
    """Raises where rows are not those of the first problems."""
    if [row["index"] for row in rows] != list(range(len(rows))):
        raise ValueError("a row is missing")
    if not all(row.keys() >= ROW for row in rows):
        raise ValueError("a row lacks quantities")


def _write(path: Path, results: dict[str, Any]) -> None:
    text = json.dumps(results, allow_nan=False)
    atomic_write(path, lambda file: file.write_text(text + "\n", encoding="utf-8"))


def main() -> None:
    """Evaluates what the command line asks for."""
    config = tyro.cli(EvaluateConfig)
    print_summary(evaluate(config))
    print(f"wrote {config.json}")


if __name__ == "__main__":
    run_command(main)
