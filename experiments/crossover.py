"""Claim: the dearer a configuration check, the more a learned guide pays; here is from where on.

    python -m experiments.crossover

The total time of a query if a configuration check cost c seconds, for c from 10 ns to 0.1 s:

    T(c) = total time as measured + configuration checks x c

from the runs of Figure 5, whose checks are nearly free. For the planners of OMPL there is a second
curve, the checks alone, T(c) = configuration checks x c: their measured time is mostly that of
callbacks into Python, and no implementation can be faster than this bound. Our own planners get no
such allowance.

Where a guide does not win: a roadmap whose nodes are tested first costs more checks than
RRT-Connect needs for an easy problem, so that gnn and gnn_lazy cannot win in the median at any
price. The guided planner can; what it pays is the milliseconds of its network and search.

What a crossover does not count: failures (a planner that gives up is not charged for it; see the
shares of solved problems), that our paths are shorter and certified (the certificate's own
distances are part of the measured time, at no further price), and that OMPL's paths are not. Means
hang on few problems; each crossover comes with what the guide saves at the highest price, and the
interval of that, over the same problems.
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
from experiments.price import (
    DEARNESS,
    GUIDES,
    Timed,
    crossovers,
    total_times,
    without_overhead,
)
from experiments.style import COLORS, label
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.errors import run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.files import atomic_write
from gnnjax.problems.shards import load_problems

CLAIM = "The dearer a configuration check, the more a learned guide pays."
OWN = (*GUIDES, "distance", "lazysp", "prm")
RIVALS = ("ompl:rrt_connect", "ompl:bit_star")

# What others' checks cost, s; ours and MuJoCo's are measured.
MARKS = {"PyBullet": 80e-6, "a simulator": 1e-2}


@dataclasses.dataclass(frozen=True)
class CrossoverConfig(ExperimentConfig):
    """Total time of the planners as a function of what a configuration check costs."""

    num_nodes: tuple[int, ...] = (200, 1000)
    """Roadmap sizes."""
    num_problems: int = 300
    """Problems of each set."""


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
    draw([row for row in rows if row["set"] == "test"], marks, config.out / "crossover.png")


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


def measure_checks(robot_name: str, path: Path, batch: int = 4096) -> dict[str, float]:
    """Seconds a configuration check costs in the fused kernel and in MuJoCo's C engine.

    Both are the least of many short times, so that other work on the machine counts little, over
    random configurations in the scene of the first problem. The engine's includes its loop in
    Python, about a tenth.
    """
    robot = load_robot(robot_name)
    problem = load_problems(path, robot).problems
    scene = jax.tree.map(lambda x: jnp.asarray(x[0]), problem.scene)
    checker = make_checker(robot, axis_aligned=True)
    fused = jax.jit(checker.check_configurations)
    bounds = robot.joint_lower, robot.joint_upper
    q = np.random.default_rng(0).uniform(*bounds, (batch, robot.num_dof)).astype(np.float32)
    engine, few = Engine(robot, scene), q[: batch // 16]

    def least(check: Any, rows: np.ndarray) -> float:
        taken = []
        for _ in range(41):  # the first compiles
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
    figure = Figure(figsize=(17, 4.6 * len(sizes) + 0.8), layout="constrained")
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
            axes.set_ylim(1e-3, 1e3)
    for axes in panels[-1]:
        axes.set_xlabel("a configuration check costs [s]")
    for axes in panels[:, 0]:
        axes.set_ylabel("total time [s]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=9)
    atomic_write(out, lambda file: figure.savefig(file, dpi=75))


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(CrossoverConfig)))
