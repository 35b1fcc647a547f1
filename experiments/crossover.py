"""Claim: the dearer a configuration check, the more a learned guide pays; here is from where on.

    python -m experiments.crossover

The total time of a query if a configuration check cost c seconds, for c from 10 ns to 0.1 s:

    T(c) = total time as measured + configuration checks x c

from the runs of Figure 5, whose checks are nearly free. For the planners of OMPL there is a second
curve, the checks alone, T(c) = configuration checks x c: their measured time is mostly that of
callbacks into Python, and no implementation can be faster than this bound. Our own planners get no
such allowance. What a crossover does not count: failures (a planner that gives up is not charged
for it; see the shares of solved problems), that our paths are shorter and certified (the
certificate's own distances are part of the measured time, at no further price), and that OMPL's
paths are not.
"""

import dataclasses
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure

from experiments.benchmark_collision import Engine
from experiments.cases import classical_case, own_case
from experiments.measure import (
    ExperimentConfig,
    command,
    problem_sets,
    run_seed,
    save_results,
    statistics,
)
from experiments.style import COLORS, label
from gnnjax.collision import make_checker
from gnnjax.errors import atomic_write, run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.problem import load_problems
from gnnjax.robot import load_robot

CLAIM = "The dearer a configuration check, the more a learned guide pays."
GUIDES = ("gnn", "gnn_lazy")
OWN = (*GUIDES, "distance", "lazysp", "prm")
RIVALS = ("ompl:rrt_connect", "ompl:bit_star")

# Seconds a configuration check may cost: a grid for the curves, and a fine one for crossovers.
DEARNESS = np.geomspace(1e-8, 1e-1, 36)
FINE = np.geomspace(1e-8, 1e-1, 701)

# What others' checks cost, s; ours and MuJoCo's are measured.
MARKS = {"PyBullet": 80e-6, "a simulator": 1e-2}


@dataclasses.dataclass(frozen=True)
class CrossoverConfig(ExperimentConfig):
    """Total time of the planners as a function of what a configuration check costs."""

    num_nodes: tuple[int, ...] = (200, 1000)
    """Roadmap sizes."""
    num_problems: int = 300
    """Problems of each set."""


@dataclasses.dataclass(frozen=True)
class Timed:
    """What a planner needed for P problems with S seeds."""

    key: dict[str, Any]  # set, planner, num_nodes, and whether it is the bound without overhead
    command: str
    time: np.ndarray  # [S, P] s
    checks: np.ndarray  # [S, P]
    solved: np.ndarray  # [S, P]
    strata: dict[str, np.ndarray]  # [P] which problems belong to "all" and "hard"


def run(config: CrossoverConfig) -> None:
    """Measures what is missing, computes curves and crossovers, and draws the figure."""
    if config.quick:
        config = dataclasses.replace(
            config, num_nodes=(30,), num_problems=3, seeds=config.seeds[:1]
        )
    robot = config.robot or "kuka_iiwa14"
    sets = problem_sets(config, robot, config.num_problems)
    timed = [t for name, path in sets.items() for t in read(config, robot, name, path)]
    marks = measure_checks(robot, sets["test"]) | MARKS
    rows = save_results(
        config,
        "crossover",
        CLAIM,
        map(curves, timed),
        check_s=DEARNESS.tolist(),
        marks_s=marks,
        crossovers=crossovers(timed),
    )
    draw([row for row in rows if row["set"] == "test"], marks, config.results / "crossover.png")


def read(config: CrossoverConfig, robot: str, name: str, path: Path) -> list[Timed]:
    """All planners on one set; the classical ones twice, with and without their overhead."""
    num = config.num_problems

    def one(case: EvaluateConfig, num_nodes: int | None) -> Timed:
        rows = [run_seed(case, seed, config.runs)["problems"] for seed in config.seeds]
        key = {"set": name, "planner": case.planner, "num_nodes": num_nodes, "bound": False}
        time, checks, solved = (
            np.array([[row[quantity] for row in seed] for seed in rows], float)
            for quantity in ("total_time_s", "configuration_checks", "success")
        )
        valid = np.array([row["valid"] for row in rows[0]])
        hard = np.array([row["hard"] for row in rows[0]])
        return Timed(key, command(case), time, checks, solved, {"all": valid, "hard": valid & hard})

    timed = [one(own_case(path, robot, p, n, num), n) for n in config.num_nodes for p in OWN]
    for planner in RIVALS:
        measured = one(classical_case(path, robot, planner, num), None)
        timed += [measured, without_overhead(measured)]
    return timed


def without_overhead(timed: Timed) -> Timed:
    """The bound: as if a planner did nothing but check."""
    return dataclasses.replace(
        timed, key=timed.key | {"bound": True}, time=np.zeros_like(timed.time)
    )


def total_times(timed: Timed, stratum: str, check_s: np.ndarray) -> np.ndarray:
    """Total times `[C, S, P']` in s of a stratum's problems, a configuration check costing
    `check_s` `[C]`."""
    chosen = timed.strata[stratum]
    time, checks = timed.time[:, chosen], timed.checks[:, chosen]
    return time + check_s[:, None, None] * checks


def curves(timed: Timed) -> dict[str, Any]:
    """A row of the results: mean with its interval and median of the total time over DEARNESS."""
    row: dict[str, Any] = {**timed.key, "command": timed.command}
    for stratum, chosen in timed.strata.items():
        times = total_times(timed, stratum, DEARNESS)
        parts = [statistics(each, np.ones(each.shape, bool)) for each in times]
        row[stratum] = {
            "num_problems": int(chosen.sum()),
            "success": statistics(timed.solved[:, chosen], np.ones(times.shape[1:], bool)),
            "total_time_s": {
                name: [part[name] for part in parts if part is not None]
                for name in ("mean", "low", "high", "median")
            },
        }
    return row


def crossovers(timed: list[Timed]) -> list[dict[str, Any]]:
    """From where on each guide is faster than each other planner of the same set and size."""
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
                found.append(key | {"stratum": stratum, "average": average} | where)
    return found


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


def measure_checks(robot_name: str, path: Path, batch: int = 16_384) -> dict[str, float]:
    """Seconds a configuration check costs in the fused kernel and in MuJoCo's C engine.

    Both are least times of five, over random configurations in the scene of the first problem. The
    engine's includes its loop in Python, about a tenth.
    """
    robot = load_robot(robot_name)
    problem = load_problems(path, robot).problems
    scene = jax.tree.map(lambda x: jnp.asarray(x[0]), problem.scene)
    checker = make_checker(robot, axis_aligned=True, max_boxes=len(scene.mask))
    fused = jax.jit(checker.check_configurations)
    bounds = robot.joint_lower, robot.joint_upper
    q = np.random.default_rng(0).uniform(*bounds, (batch, robot.num_dof)).astype(np.float32)
    engine, few = Engine(robot, scene), q[: batch // 8]

    def least(check: Any, rows: np.ndarray) -> float:
        taken = []
        for _ in range(6):  # the first compiles
            begin = perf_counter()
            jax.block_until_ready(check(rows))
            taken.append(perf_counter() - begin)
        return min(taken[1:]) / len(rows)

    return {
        "our fused kernel": least(lambda rows: fused(scene, rows), q),
        "MuJoCo's C engine": least(engine.valid, few),
    }


def draw(rows: list[dict[str, Any]], marks: dict[str, float], out: Path) -> None:
    """Draws mean and median over what a check costs: a row of panels a roadmap size."""
    sizes = sorted({row["num_nodes"] for row in rows if row["num_nodes"]})
    figure = Figure(figsize=(17, 4.2 * len(sizes) + 0.8), layout="constrained")
    columns = [(s, a) for s in ("all", "hard") for a in ("mean", "median")]
    panels = np.atleast_2d(figure.subplots(len(sizes), 4, sharex=True, sharey=True))
    for num_nodes, line in zip(sizes, panels, strict=True):
        for (stratum, average), axes in zip(columns, line, strict=True):
            for row in rows:
                times = row[stratum]["total_time_s"]
                if row["num_nodes"] not in (None, num_nodes) or not times[average]:
                    continue
                planner, name = row["planner"], label(row["planner"])
                classical = planner.startswith("ompl:")
                style = ":" if row["bound"] else "--" if classical else "-"
                name += ", checks alone" if row["bound"] else ""
                axes.plot(DEARNESS, times[average], style, color=COLORS[planner], label=name)
                if average == "mean":
                    band = times["low"], times["high"]
                    axes.fill_between(DEARNESS, *band, color=COLORS[planner], alpha=0.12, lw=0)
            for name, at in marks.items():
                axes.axvline(at, color="0.75", lw=0.8, zorder=0)
                axes.annotate(
                    name, (at, 0.02), xycoords=("data", "axes fraction"), rotation=90, fontsize=7
                )
            axes.set(xscale="log", yscale="log", title=f"N = {num_nodes}: {average}, {stratum}")
    for axes in panels[-1]:
        axes.set_xlabel("a configuration check costs [s]")
    for axes in panels[:, 0]:
        axes.set_ylabel("total time [s]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=9)
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(CrossoverConfig)))
