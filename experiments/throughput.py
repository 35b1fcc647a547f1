"""Claim: many problems at once are planned faster than by RRT-Connect on all cores.

    python -m experiments.throughput
    python -m experiments.throughput --problems data/kuka_iiwa14_public.npz

Problems a second, on the wall clock from the arrays of all problems to the arrays of certified
paths; checking the queries is part of it, compilation is not: everything is planned once before,
untimed. Two processes, each on a core of its own, share the problems; the clock runs for both
together. The guided planner, with and without shortening, plans as many distinct problems at once
as the pool has room for, half of them in each process; a larger pool than there are problems holds
all of them. RRT-Connect, with and without OMPL's simplification, tests with the same kernel and
plans one problem after the other. Who is compared takes turns, so that whatever else the machine
does slows all of them; ratios are those within a turn, and of all turns the median counts. The
other pools plan in the first turn alone. Turns are kept in `runs/`, and a run that was cut off goes
on with the next one.

Strata: all accepted problems, which include some that nobody solves and that RRT-Connect spends its
time limit on; and those that the guided planner solves. Refused problems (an end in collision) are
part of the arrays in the first stratum, but do not count as planned.

Total times are those of single queries: pools of one, in one process, and all of RRT-Connect's.
They hold the check of the query, and the guided planner's the certificate; RRT-Connect's paths are
certified afterwards, on the wall clock but not in the total time.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.by_pool import OWN, RIVALS, STRATA, draw, of_stratum, ratio, ratio_a_core, table
from experiments.cases import classical_case
from experiments.contenders import (
    Turn,
    in_pools,
    in_processes,
    peak_memory,
    planner_of,
    problems_of,
    processes_of,
    start_workers,
)
from experiments.measure import ExperimentConfig
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.style import label
from experiments.turns import Columns, folder_of, kept, per_s, summarize, summarize_turn
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig
from gnnjax.generate import GenerateConfig, generate
from gnnjax.problems.shards import load_problems

COMPARED = 256  # the pool that is set against RRT-Connect, and that growth is counted from


@dataclasses.dataclass(frozen=True)
class ThroughputConfig(ExperimentConfig):
    """Plans a second by how many problems are planned at once; of the seeds, the first alone."""

    problems: Path | None = None
    """The problem set; by default as many problems as the largest pool holds, which are generated
    if they are missing."""
    num_problems: int | None = None
    """Only the first so many problems."""
    pools: tuple[int, ...] = (1, 16, 256, 1024, 4096)
    """Problems that are planned at once."""
    singles: int = 200
    """Problems that a pool of one plans."""
    turns: int = 3
    """Times that those who are compared plan everything."""
    time_limit: float = 1.0
    """Seconds after which RRT-Connect gives a problem up."""
    processes: int = 2
    """Processes that share the problems, ours and RRT-Connect's alike."""
    memory_pool: int = 1024
    """Problems planned at once by the process whose memory is measured."""


class Contender(NamedTuple):
    """A planner, and how many problems it is given at once."""

    planner: str
    pool: int | None  # None: one after the other, in processes of their own


def measurement(config: ThroughputConfig) -> Measurement:
    """Rows of all contenders on both strata."""
    robot = config.robot or "kuka_iiwa14"
    if min(*config.pools, config.singles, config.turns, config.processes, config.memory_pool) < 1:
        raise InputError("pools, singles, turns, processes and memory_pool must be at least 1")
    path = _problems(config, robot)
    arm = load_robot(robot)
    num = len(load_problems(path, arm).take(slice(config.num_problems)))
    pools = sorted({min(pool, num) for pool in config.pools})
    settings = {
        "robot": Path(robot).stem,
        "set": path.stem,
        "num_problems": num,
        "pools": pools,
        "singles": min(config.singles, num),
        "time_limit": config.time_limit,
        "processes": config.processes,
        "seed": config.seeds[0],
    }
    name = f"throughput_{path.stem}"
    folder = folder_of(config.runs, name, settings, path, arm.path)

    def case(planner: str) -> EvaluateConfig:
        limit = config.time_limit if planner.startswith("ompl:") else np.inf
        made = classical_case(path, robot, planner)
        return dataclasses.replace(made, time_limit=limit, seed=config.seeds[0])

    most = min(config.memory_pool, num)
    # First of all: a new process takes over the peak of the one that starts it.
    memory = kept(
        folder / f"memory_{most}.json", lambda: {"MiB": peak_memory(case("guided"), most)}
    )
    head = {"settings": settings, "peak_memory": {"pool": most, **memory}}
    return Measurement(_rows(config, case, settings, folder), head)


def _problems(config: ThroughputConfig, robot: str) -> Path:
    if config.problems is not None:
        return config.problems
    quick = "_quick" if config.quick else ""
    path = config.data / f"{Path(robot).stem}_throughput{quick}.npz"
    if not path.exists():
        most = max(config.pools)
        generate(GenerateConfig(split="test", robot=robot, num_problems=most, out=path))
    return path


def contenders(pools: Sequence[int], number: int = 0) -> list[Contender]:
    """Who takes part in a turn, in this order; who is compared, side by side. After the first turn
    these are the pools that ratios are of, and RRT-Connect."""
    compared = compared_pool(pools)
    beside = [(Contender(own, compared), Contender(RIVALS[own], None)) for own in OWN]
    others = [pool for pool in reversed(pools) if pool != compared]
    others = [pool for pool in others if number == 0 or pool == pools[-1]]
    return [
        *(each for pair in beside for each in pair),
        *(Contender(own, pool) for pool in others for own in OWN),
    ]


def compared_pool(pools: Sequence[int]) -> int:
    """The largest pool up to COMPARED, or the smallest there is."""
    return max((pool for pool in pools if pool <= COMPARED), default=min(pools))


def _rows(
    config: ThroughputConfig,
    case: Callable[[str], EvaluateConfig],
    settings: dict[str, Any],
    folder: Path,
) -> Iterator[Row]:
    pools, guided = settings["pools"], case("guided")
    problems = problems_of(guided)
    chosen = np.arange(settings["num_problems"])
    with start_workers(config.processes) as workers:

        def plan(contender: Contender, rows: np.ndarray) -> Turn:
            made = case(contender.planner)
            if contender.pool is None:
                return in_processes(workers, made, rows)
            some = rows[: settings["singles"]] if contender.pool == 1 else rows
            own = jax.tree.map(lambda x: x[some], problems)
            alone = contender.pool == 1
            planner = planner_of(made) if alone else processes_of(made, config.processes)
            return in_pools(planner, own, contender.pool, made.seed)

        warm: set[tuple[Contender, int]] = set()

        def take_turn(stratum: str, number: int, rows: np.ndarray) -> list[Columns]:
            taking_part, found = contenders(pools, number), []
            for contender in taking_part:
                # What is compiled for batches depends on how large they are.
                shape = contender, 0 if contender.pool in (1, None) else len(rows)
                if shape not in warm:
                    plan(contender, rows)
                    warm.add(shape)
            for contender in taking_part:
                found.append(summarize_turn(plan(contender, rows)))
                pool = f"pool {contender.pool}" if contender.pool else "one by one"
                words = f"{stratum}, turn {number}: {label(contender.planner)}, {pool}"
                print(f"{words}: {per_s(found[-1]):.1f} plans/s", flush=True)
            return found

        for stratum in STRATA:
            turns: dict[Contender, list[Columns]] = {}
            for number in range(config.turns):
                path = folder / f"{stratum}_{number}.json"
                found = kept(path, functools.partial(take_turn, stratum, number, chosen))
                for contender, columns in zip(contenders(pools, number), found, strict=True):
                    turns.setdefault(contender, []).append(columns)
            for contender, taken in turns.items():
                yield {"stratum": stratum, **contender._asdict()} | summarize(taken)
            # Which problems are solved does not depend on the pool.
            chosen = chosen[np.array(turns[Contender("guided", pools[-1])][0]["success"], bool)]
            if not len(chosen):
                break


def verdict(results: Row) -> str:
    """Whether a pool of 256 is ahead of RRT-Connect in each stratum, and how rates grow beyond."""
    pools = results["settings"]["pools"]
    pool, largest = compared_pool(pools), max(pools)
    findings, growth = [], []
    for stratum, title in STRATA.items():
        rows = of_stratum(results, stratum)
        for own, rival in RIVALS.items():
            if not rows:
                continue
            ours, theirs = rows[own, pool], rows[rival, None]
            times = ratio(ours, theirs)
            text = f"{title}: {label(own)} plans {np.median(ours['per_s']):.0f} a second in a pool "
            text += f"of {pool}, {times:.2f} times {label(rival)}, "
            text += f"and {ratio_a_core(ours, theirs):.2f} times as many a second of CPU time"
            findings.append(Finding(times > 1, text))
            more = ratio(rows[own, largest], ours)
            growth.append(f"{more:.2f} times as many ({label(own)}, {title})")
    beside = [f"A pool of {largest} plans, of those of {pool}, {'; '.join(growth)}."]
    return judge(*findings, beside=beside if largest > pool else [])


EXPERIMENT = Experiment(
    name="throughput",
    title="Many problems at once",
    claim="Many problems at once are planned faster than by RRT-Connect on all cores.",
    config=ThroughputConfig,
    quick={"num_problems": 6, "pools": (1, 4), "singles": 2, "turns": 1, "memory_pool": 4},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)


if __name__ == "__main__":
    main(EXPERIMENT)
