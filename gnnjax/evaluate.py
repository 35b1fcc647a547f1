"""Plans all problems of a set and sums up: success, checks, times and costs.

    python -m gnnjax.evaluate --problems data/kuka_iiwa14_test.npz --json guided.json

`--figure guided.png` draws the summary, `--beside rrtc.json` those of other planners with it.

A path that comes after the time limit is a failure, whatever the planner. Results are written as
they come; the same command goes on where it was cut off.

    srun python -m gnnjax.evaluate --distributed ...   # on many machines, see docs/cluster.md
"""

import contextlib
import dataclasses
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gnnjax.arguments import parse_arguments
from gnnjax.arm_options import HoldingOptions, load_arm
from gnnjax.cluster import ALONE, Cluster
from gnnjax.errors import InputError, brief, check_seed, needs_extra, run_command
from gnnjax.files import as_json, check_apart, check_target, locked
from gnnjax.measure.batches import Batches
from gnnjax.measure.machine import describe_machine, ompl_version
from gnnjax.measure.own_planner import check_arm, checksums_of, own_settings
from gnnjax.measure.result_files import (
    FORMAT,
    OF_ARM,
    RowFiles,
    names_of,
    read_results,
    read_rows,
    write_results,
)
from gnnjax.measure.statistics import columns_of, summarize, summarize_columns
from gnnjax.measure.table import print_summary, titles_of
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.planner import Planner
from gnnjax.planning.processes import LEAST_SHARE, PlannerProcesses
from gnnjax.planning.query import QueryPlanner
from gnnjax.problems.shards import StoredProblems
from gnnjax.roll_call import RollCall

_LOG = logging.getLogger(__name__)
_WRITE_EVERY_S = 1.0
_CHECKSUM = "problems_sha256"


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateConfig(HoldingOptions, PlannerOptions):
    """Plan every problem of a set and write results and a summary as JSON."""

    problems: Path
    """An .npz of problems, or a folder of shards."""
    json: Path
    """Where results go; results of the same settings that are there already are continued."""
    num_problems: int | None = None
    """Only the first so many problems."""
    batch_size: int = 1
    """Problems planned at once, fewer where memory does not suffice. With 1, times are those of
    single queries; with more, each problem has an equal share of the time of its batch."""
    processes: int = 1
    """Worker processes on this machine that share each batch, each on a core of its own; not for
    OMPL's planners. Times are those of a batch. With --distributed, every process has its own
    batches and workers."""
    time_limit: float = 5.0
    """Seconds a problem may take; a path that comes later is a failure."""
    seed: int = 0
    """Seed of roadmaps and trees, or of OMPL's random numbers."""
    keep_parts: bool = False
    """Leave the rows in the folder JSON.parts, in files of up to some thousand, and write only
    their summary into the JSON. This is for more rows than fit into memory."""
    figure: Path | None = None
    """Where a picture of the summary goes (needs the viz extra)."""
    beside: tuple[Path, ...] = ()
    """Results of the same problems, of other planners, that the picture shows, too."""
    cluster: Cluster = ALONE


def planner_for(config: EvaluateConfig) -> QueryPlanner:
    """The planner that a configuration asks for, for the arm with what it holds."""
    return make_planner(load_arm(config), config)


def evaluate(config: EvaluateConfig, planner: QueryPlanner | None = None) -> dict[str, Any]:
    """Plans what is missing of a set's results, and returns them all as they are in the file; of
    several processes, to the first one alone.

    Args:
        config: what to plan, and how.
        planner: of these options, for callers that evaluate several sets or seeds with one, or a
            guide or scorer of their own; results of such a one are not gone on with.
    """
    if config.batch_size < 1 or (config.num_problems is not None and config.num_problems < 1):
        raise InputError(
            f"batch_size is {config.batch_size}, num_problems {config.num_problems}; "
            "both must be at least 1"
        )
    _check_processes(config)
    check_seed(config.seed)
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{field.name} is {value}; give a number that is finite")
    check_target(config.json)
    check_apart((config.json, config.figure), (config.problems, config.attach, config.robot))
    place = config.cluster.place()
    parts = config.json.with_name(f"{config.json.name}.parts")
    files = [config.json, parts][: 2 if place.count == 1 else 1]  # another may have made parts
    own = {}
    if planner is None:
        planner = planner_for(config)
    else:
        check_arm(planner, load_arm(config))
        own = own_settings(planner, config, files)
    problems = StoredProblems(config.problems, planner.robot)
    num = min(len(problems), config.num_problems or len(problems))
    settings = as_json(dataclasses.asdict(config))
    for name in ("json", "cluster", "keep_parts", "figure", "beside"):  # change no row
        del settings[name]
    checksums = {_CHECKSUM: problems.sha256()} | checksums_of(planner)
    settings |= {"num_problems": num, "radius": planner.radius} | checksums | own
    draw = _drawing(config, settings)
    results = {
        "format": FORMAT,
        "complete": False,
        "settings": settings,
        "machine": describe_machine() | ompl_version(config.is_classical),
        "summary": {},
        "problems": [],
    }
    with contextlib.ExitStack() as held:
        others = held.enter_context(config.cluster.roll_call(config.json))
        if place.index == 0:
            held.enter_context(locked(config.json))
        planner = held.enter_context(_in_processes(planner, config))
        run = Batches(
            *(planner, config, problems, num),
            batch_size=config.batch_size,
            seed=config.seed,
            time_limit=config.time_limit,
        )
        if place.count > 1 or config.keep_parts or parts.exists():
            results = _evaluate_parts(run, results, parts, others, config)
        else:
            results = _evaluate(run, results, config.json)
        if results:
            draw(results)
        return results


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


_ARM_FILES = "robot_sha256"
# What results share that a picture compares.
_SAME = ("problems", _CHECKSUM, "num_problems", *OF_ARM, _ARM_FILES, "time_limit")


def _drawing(
    config: EvaluateConfig, settings: dict[str, Any]
) -> Callable[[dict[str, Any]], object]:
    """What draws results into the picture that is asked for, with those beside.

    Raises:
        InputError: a picture that cannot be drawn, or others that are not of the same problems.
    """
    if config.figure is None:
        if config.beside:
            raise InputError("--beside names results for a picture; give --figure, too")
        return lambda results: None
    with needs_extra("--figure", "viz"):
        from gnnjax.measure.figure import draw_summary
        from gnnjax.plot import check_picture
    figure = check_picture(config.figure)
    names = names_of([config.json, *config.beside])
    others = {names[path]: read_results(path, rows=False) for path in config.beside}
    for name, other in others.items():
        theirs = {_CHECKSUM: settings[_CHECKSUM]} | other["settings"]
        if _CHECKSUM not in other["settings"]:
            _LOG.warning("%r of --beside is older and does not tell which problems it had", name)
        told = [key for key in _SAME if key != _ARM_FILES or key in theirs]  # older ones do not
        for key in told:
            if _shared(theirs, key) != _shared(settings, key):
                raise InputError(
                    f"{name!r} of --beside has {key} {brief(theirs.get(key))}, not "
                    f"{brief(settings[key])}; name results of the same problems"
                )

    def draw(results: dict[str, Any]) -> None:
        named = {names[config.json]: results} | others
        titles = titles_of([each["settings"] for each in named.values()])
        summaries = {
            f"{title} ({name})" if titles.count(title) > 1 else title: each["summary"]
            for title, (name, each) in zip(titles, named.items(), strict=True)
        }
        title = f"{config.problems.stem}, {settings['time_limit']:g} s a problem at most"
        draw_summary(summaries, title, figure)

    return draw


def _shared(settings: dict[str, Any], key: str) -> Any:
    """A setting by which results compare; a path by its name, wherever it was named from."""
    value = settings.get(key) or None  # what was no option yet is off, whatever that looks like
    return Path(value).stem if key in ("problems", "robot") else value


def _evaluate(run: Batches, results: dict[str, Any], path: Path) -> dict[str, Any]:
    """All into one file, which is written as results come."""
    rows = results["problems"] = _earlier(path, results["settings"])
    if len(rows) < run.num:
        # Seen now rather than after the first problems: a path that cannot be written.
        write_results(path, results)
        written = time.monotonic()
        with run.progress(run.num, len(rows)):
            for new in run.plan(len(rows), run.num):
                rows += new
                if time.monotonic() - written > _WRITE_EVERY_S:
                    write_results(path, results)
                    written = time.monotonic()
    results["summary"], results["complete"] = summarize(rows), True
    write_results(path, results)
    return results


def _evaluate_parts(
    run: Batches, results: dict[str, Any], folder: Path, others: RollCall, config: EvaluateConfig
) -> dict[str, Any]:
    """Those of a process's files that are missing; the first process then sums up all of them."""
    path, settings, place = config.json, results["settings"], config.cluster.place()
    # What one process alone has come to, before or at last.
    whole = _earlier(path, settings)
    parts = RowFiles(
        *(folder, run.num, config.batch_size, whole),
        read=lambda file, first: _earlier(file, settings, first),
    )
    missing = parts.missing(place)
    with run.progress(sum(last - first for first, last in map(parts.bounds.__getitem__, missing))):
        for index in missing:
            rows = [row for new in run.plan(*parts.bounds[index]) for row in new]
            write_results(parts.files[index], results | {"complete": True, "problems": rows})
    if not others.gather():
        return {}
    if place.count > 1:
        results["machine"]["processes"] = place.count  # of which this is the first one's
    numbers = range(len(parts.files))
    if config.keep_parts and len(whole) < run.num:
        for i in numbers:  # of an earlier run, in whose file rows will not be any more
            if not parts.files[i].exists():
                done = results | {"complete": True, "problems": parts.rows(i)}
                write_results(parts.files[i], done)
        columns = [columns_of(parts.rows(i)) for i in numbers]
        joined = {name: np.concatenate([x[name] for x in columns]) for name in columns[0]}
        results["summary"] = summarize_columns(joined)
        results["parts"] = [file.name for file in parts.files]
    else:
        results["problems"] = rows = [row for i in numbers for row in parts.rows(i)]
        results["summary"] = summarize(rows)
    results["complete"] = True
    write_results(path, results)
    if not config.keep_parts:
        parts.remove()
    return results


def _earlier(path: Path, settings: dict[str, Any], first: int = 0) -> list[dict]:
    fields = dataclasses.fields(EvaluateConfig)
    defaults = {f.name: f.default for f in fields if f.default is not dataclasses.MISSING}
    # Files from before there were checksums leave them open.
    defaults |= {name: value for name, value in settings.items() if name.endswith("_sha256")}
    return read_rows(path, {"own": None} | settings, defaults, first)


def main() -> None:
    """Evaluates what the command line asks for."""
    config = parse_arguments(EvaluateConfig)
    if results := evaluate(config):
        print_summary(results)
        print(f"wrote {config.json}" + (f" and {config.figure}" if config.figure else ""))


if __name__ == "__main__":
    run_command(main, smaller="give a smaller --batch-size or --num-nodes")
