"""Claim: the dearer a configuration check, the more a guide pays; here is from where on.

    python -m experiments.crossover

The total time of a query if a configuration check cost c seconds, for c from 10 ns to 0.1 s:

    T(c) = total time as measured + configuration checks x c

from the runs of Figure 5, whose checks are nearly free. The guided planner is told the price: above
10 us it is another, which asks for fewer checks (`--check-cost`). For the planners of OMPL there is
a second curve, the checks alone, T(c) = configuration checks x c: their measured time is mostly
that of callbacks into Python, and no implementation can be faster than this bound. Our own planners
get no such allowance.

Where a guide does not win: a roadmap whose nodes are tested first costs more checks than
RRT-Connect needs for an easy problem, so that gnn and gnn_lazy cannot win in the median at any
price. The guided planner can; what it pays is the milliseconds of its field and search.

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
from matplotlib.figure import Figure

from experiments.cases import classical_case, own_case
from experiments.engine import Engine
from experiments.measure import ExperimentConfig, command, measure_problems, problem_sets
from experiments.price import (
    DEARNESS,
    GUIDES,
    Timed,
    crossovers,
    total_times,
    without_overhead,
)
from experiments.published import CHECK_S
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row, of_set
from experiments.statistics import column, statistics
from experiments.style import COLORS, label
from experiments.tables import listing, markdown, seconds
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.evaluate import EvaluateConfig
from gnnjax.problems.shards import load_problems

OWN = (*GUIDES, "distance", "lazysp", "prm")
RIVALS = ("ompl:rrt_connect", "ompl:bit_star")


@dataclasses.dataclass(frozen=True)
class CrossoverConfig(ExperimentConfig):
    """Total time of the planners as a function of what a configuration check costs."""

    num_nodes: tuple[int, ...] = (200, 1000)
    """Roadmap sizes."""
    num_problems: int = 300
    """Problems of each set."""


def measurement(config: CrossoverConfig) -> Measurement:
    """Curves of the planners, and where they cross."""
    robot = config.robot or "kuka_iiwa14"
    sets = problem_sets(config, robot, config.num_problems)
    timed = [t for name, path in sets.items() for t in read(config, robot, name, path)]
    head = {
        "check_s": DEARNESS.tolist(),
        "marks_s": measure_checks(robot, sets["test"]) | CHECK_S,
        "crossovers": crossovers(timed),
    }
    return Measurement(map(curves, timed), head)


def read(config: CrossoverConfig, robot: str, name: str, path: Path) -> list[Timed]:
    """All planners on one set; the classical ones twice, with and without their overhead."""
    num = config.num_problems

    def one(case: EvaluateConfig, num_nodes: int | None) -> Timed:
        rows = measure_problems(config, case)
        key = {"set": name, "planner": case.planner, "num_nodes": num_nodes, "bound": False}
        time, checks, solved = (
            column(rows, lambda row, quantity=quantity: row[quantity])
            for quantity in ("total_time_s", "configuration_checks", "success")
        )
        valid = np.array([row["valid"] for row in rows[0]])
        hard = np.array([row["hard"] for row in rows[0]])
        return Timed(key, command(case), time, checks, solved, {"all": valid, "hard": valid & hard})

    def own(planner: str, num_nodes: int) -> Timed:
        found = one(own_case(path, robot, planner, num_nodes, num), num_nodes)
        if planner != "guided":
            return found
        case = own_case(path, robot, "guided_dear", num_nodes, num)
        return dataclasses.replace(found, dear=one(case, num_nodes))

    timed = [own(p, n) for n in config.num_nodes for p in OWN]
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


def draw(results: Row) -> Figure:
    """Draws mean and median over what a check costs: a row of panels a roadmap size."""
    rows = of_set(results, "test")
    sizes = sorted({row["num_nodes"] for row in rows if row["num_nodes"]})
    figure = Figure(figsize=(17, 4.6 * len(sizes) + 0.8), dpi=75, layout="constrained")
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
            for name, at in results["marks_s"].items():
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
    return figure


def table(results: Row) -> str:
    """From which price of a configuration check on a guide is faster, hard problems."""
    there = {found["guide"] for found in results["crossovers"]}
    guides = [guide for guide in GUIDES if guide in there]
    columns = [(guide, average) for guide in guides for average in ("mean", "median")]
    lines: dict[tuple, dict[tuple, str]] = {}
    for found in _hard(results):
        rival = label(found["rival"]) + (", checks alone" if found["bound"] else "")
        line = lines.setdefault((str(found["num_nodes"]), rival), {})
        line[found["guide"], found["average"]] = seconds(found["from_s"])
    head = ["N", "against", *[f"{guide}, {average}" for guide, average in columns]]
    note = "From which price of a configuration check on a guide is faster, hard test problems.\n"
    return (
        note
        + "\n"
        + markdown(
            head, [[*key, *[line[column] for column in columns]] for key, line in lines.items()]
        )
    )


def _hard(results: Row) -> list[Row]:
    """The crossovers of guides with planners that have none, on hard test problems."""
    return [
        found
        for found in results["crossovers"]
        if (found["set"], found["stratum"]) == ("test", "hard") and found["rival"] not in GUIDES
    ]


def verdict(results: Row) -> str:
    """Whether the default planner is faster than each other from some price on."""

    def of(guide: str, average: str) -> list[Row]:
        return [c for c in _hard(results) if (c["guide"], c["average"]) == (guide, average)]

    def finding(average: str) -> Finding:
        prices = [found["from_s"] for found in of("guided", average)]
        reached = [price for price in prices if price is not None]
        if len(reached) < len(prices) or not prices:
            won = f"against {len(reached)} of {len(prices)} only"
        else:
            won = f"against all, at the latest from {seconds(max(reached))} a check on"
        return Finding(0 < len(reached) == len(prices), f"guided is faster in the {average} {won}")

    others = []
    for guide in ("gnn", "gnn_lazy"):
        found = [*of(guide, "mean"), *of(guide, "median")]
        never = dict.fromkeys(label(c["rival"]) for c in found if c["from_s"] is None)
        others += [f"for {guide} against {listing([*never])}"] if never else []
    beside = []
    if others:
        where = "At some roadmap size there is no such price, in the mean or in the median,"
        beside = [f"{where} {listing(others)}."]
    return judge(finding("mean"), finding("median"), beside=beside)


EXPERIMENT = Experiment(
    name="crossover",
    title="When a guide pays",
    claim="The dearer a configuration check, the more a guide pays.",
    config=CrossoverConfig,
    quick={"num_nodes": (30,), "num_problems": 3},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
