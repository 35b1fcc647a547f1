"""Claim: planned motions can be carried out by an arm that is not quite as its model, more often
than the paper's.

    python -m experiments.real_arm

The paper took ten problems to a real arm: eight were solved, and six of the paths suited the arm,
the others being too close to obstacles or swinging back and forth. Here MuJoCo stands for the arm,
with contacts, motors that have limits, and errors that no controller knows: it is a tenth heavier
than its model, has dry friction, and answers late.

Paths are planned with a margin, and timed within the arm's limits of velocity, acceleration and
torque, of which a reserve is left to the controller, along curves that are proven to keep half of
that margin. A payload is known to timing and controller. A motion is *found* where there is a path,
*timed* where there is a motion along it, and *suitable* where this is carried out without a
contact, ends at rest at the goal, and no joint swings (`carried_out.py`).
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from experiments.carried_out import COUNTS, summarize, told
from experiments.cases import classical_case, own_case
from experiments.measure import ExperimentConfig, problem_set
from experiments.published import REAL_ARM
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.statistics import proportion
from experiments.style import draw_bars, label
from experiments.tables import cell, interval, markdown
from experiments.turns import folder_of, kept
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.evaluate import EvaluateConfig
from gnnjax.planning.load import make_planner
from gnnjax.planning.query import check_queries
from gnnjax.problems.problem import Problem
from gnnjax.problems.shards import load_problems
from gnnjax.scene.shapes import sphere
from gnnjax.trajectory.execution import execute_trajectories
from gnnjax.trajectory.limits import limits_of
from gnnjax.trajectory.simulate import ModelErrors
from gnnjax.trajectory.trajectory import time_paths

OWN, RIVAL, PAPER = "guided", "ompl:rrt_connect@simplified", "gnn_paper"
PLANNERS = (OWN, RIVAL, PAPER)
_PAPER_ARM = "kuka_iiwa14"  # which its network was trained on
_BESIDE = 0.001  # m, radius of the payload: inside of the link that carries it


@dataclasses.dataclass(frozen=True)
class RealArmConfig(ExperimentConfig):
    """Carry out what is planned, in simulation; of the seeds, the first alone."""

    arms: tuple[str, ...] = ("kuka_iiwa14", "franka_panda", "kinova_gen3")
    """The arms."""
    families: tuple[str, ...] = ("paper", "shelf")
    """Kinds of problems."""
    num_problems: int = 100
    """Problems of each kind, for each arm."""
    payloads: tuple[float, ...] = (0.0, 1.0, 3.0)
    """What the last link carries, kg."""
    margin: float = 0.02
    """Clearance that paths keep, m; curves keep half of it."""
    mass_error: float = 0.1
    """Share by which the arm is heavier than its model."""
    friction: float = 0.5
    """Dry friction that the model does not have, N m."""
    delay: float = 0.004
    """Seconds from what is measured to the torque that answers it."""
    reserve: float = 0.2
    """Share of the motors' torques that motions leave to the controller."""


def measurement(config: RealArmConfig) -> Measurement:
    """Rows of planners, for each arm, kind of problems and payload."""
    names = ("num_problems", "payloads", "margin", "mass_error", "friction", "delay", "reserve")
    settings = {name: getattr(config, name) for name in names}
    return Measurement(_rows(config, settings), {"settings": settings})


def _rows(config: RealArmConfig, settings: Row) -> Iterator[Row]:
    # All arms come with one kind of problems before any comes with the next.
    for family in config.families:
        for arm in (config.robot,) if config.robot else config.arms:
            # Of the set that other experiments use, the first.
            num = config.num_problems if config.quick else max(300, config.num_problems)
            path = problem_set(config, arm, family=family, num_problems=num)
            told = [settings, config.seeds[0]]
            folder = folder_of(config.runs, f"real_arm_{path.stem}", told, path)
            problems = load_problems(path, load_robot(arm)).take(slice(config.num_problems))
            for planner in PLANNERS[: 3 if arm == _PAPER_ARM else 2]:
                for row in _rows_of(config, arm, planner, path, problems.problems, folder):
                    named = {"arm": Path(arm).stem, "family": family, "planner": planner}
                    yield named | row


def _rows_of(
    config: RealArmConfig, arm: str, planner: str, path: Path, problems: Problem, folder: Path
) -> Iterator[Row]:
    """A row a payload."""
    case = classical_case(path, arm, planner)
    if planner == PAPER:
        case = own_case(path, arm, planner, num_nodes=1000)
    case = dataclasses.replace(case, margin=config.margin, seed=config.seeds[0])
    stem = planner.replace(":", "-")
    plans = kept(folder / f"{stem}.json", functools.partial(plan, load_robot(arm), case, problems))
    for payload in config.payloads:
        measure = functools.partial(carry_out, config, loaded(arm, payload), problems, plans)
        row = summarize(kept(folder / f"{stem}_{payload:g}.json", measure))
        line = f"{row['suitable']} of {row['accepted']} motions are suitable"
        print(f"{folder.name}, {label(planner)}, {payload:g} kg: {line}", flush=True)
        yield {"payload": payload} | row


def plan(robot: Robot, case: EvaluateConfig, problems: Problem) -> list[dict[str, Any]]:
    """Of each problem, whether its ends have the margin, and the path if there is one."""
    reasons = check_queries(robot, problems, case.margin)
    accepted = np.flatnonzero([reason is None for reason in reasons])
    plans = make_planner(robot, case).plan_batch(
        jax.tree.map(lambda x: x[accepted], problems), seed=case.seed
    )
    paths: list[Any] = [None] * len(reasons)
    for i, found in zip(accepted.tolist(), plans, strict=True):
        paths[i] = np.asarray(found.path, float).tolist() if found.success else None
    return [
        {"accepted": reason is None, "path": path}
        for reason, path in zip(reasons, paths, strict=True)
    ]


@functools.cache
def loaded(arm: str, payload: float) -> Robot:
    """The arm with a payload in its last link that adds nothing to what can collide."""
    robot = load_robot(arm)
    if not payload:
        return robot
    ball, own = sphere([0.0, 0.0, 0.0], _BESIDE), [x.name for x in robot.bodies if x.name]
    return robot.attach(own[-1], [ball], mass=payload, allow=["world", *own])


def carry_out(
    config: RealArmConfig, robot: Robot, problems: Problem, plans: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Times all paths and carries out their motions; a row a problem."""
    rows: list[dict[str, Any]] = [
        {"accepted": x["accepted"], "found": x["path"] is not None, "timed": False} for x in plans
    ]
    found = np.flatnonzero([row["found"] for row in rows])
    scenes = jax.tree.map(lambda x: np.asarray(x)[found], problems.scene)
    paths = [np.array(plans[i]["path"]) for i in found.tolist()]
    limit = limits_of(robot).torque
    torque = None if limit is None else (1 - config.reserve) * limit
    motions = time_paths(robot, scenes, paths, margin=config.margin / 2, torque=torque)
    timed = np.flatnonzero([motion.success for motion in motions])
    executions = execute_trajectories(
        robot,
        jax.tree.map(lambda x: x[timed], scenes),
        [motions[i] for i in timed.tolist()],
        errors=ModelErrors(config.mass_error, config.friction, config.delay),
    )
    for i, motion in zip(found.tolist(), motions, strict=True):
        rows[i] |= {"timed": motion.success, "reason": motion.reason}
    for i, execution in zip(found[timed].tolist(), executions, strict=True):
        rows[i] |= told(execution)
    return rows


def draw(results: Row) -> Figure:
    """Draws bars of the shares that are suitable: a group an arm and payload, over all problems."""
    rows = results["rows"]
    groups = list(dict.fromkeys((row["arm"], row["payload"]) for row in rows))
    shares = {
        planner: [_together(rows, planner, arm=arm, payload=kg)["share"] for arm, kg in groups]
        for planner in PLANNERS
    }
    figure = Figure(figsize=(11, 4), dpi=100, layout="constrained")
    axes = figure.subplots()
    draw_bars(axes, shares, [f"{arm}\n{kg:g} kg" for arm, kg in groups], 100)
    axes.axhline(100 * REAL_ARM["gnn"]["suitable"], color="0.4", linestyle=":", linewidth=1)
    axes.set_title("suitable motions, % of problems (dotted: the paper's 6 of 10)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _together(rows: list[Row], planner: str, **where: Any) -> dict[str, Any]:
    """Counts of a planner over all kinds of problems, and the share that is suitable."""
    own = [
        row
        for row in rows
        if row["planner"] == planner and all(row[key] == value for key, value in where.items())
    ]
    counts = {name: sum(row[name] for row in own) for name in COUNTS}
    named = {(row["family"], row["payload"]) for row in own}
    # Payloads share their problems, which are what is drawn at random.
    payloads = max(1, len({payload for _, payload in named}))
    share = proportion(counts["suitable"] / payloads, counts["accepted"] / payloads)
    return counts | {"share": share, "rows": named}


def table(results: Row) -> str:
    """A line an arm, kind of problems, planner and payload."""
    settings, machine = results["settings"], results["machine"]
    words = (
        f"{settings['num_problems']} problems of each kind and arm, those whose ends have "
        f"{1e3 * settings['margin']:g} mm to all obstacles. The arm is "
        f"{100 * settings['mass_error']:g} % heavier than its model, has {settings['friction']:g} "
        f"N m of dry friction in each joint, and torques come {1e3 * settings['delay']:g} ms late; "
        f"motions leave {100 * settings['reserve']:g} % of the motors' torques to the controller; "
        "controller: computed torque. Proven: no point of the arm strayed from the curve by as "
        "much as that is proven to keep from all obstacles. Errors are largest ones of a motion. "
        f"{machine['processor']}, {machine['cores']} cores, gnnjax {machine['gnnjax']}.\n"
    )
    head = "arm,problems,planner,payload [kg],accepted,found,timed,touched,swings,not at rest"
    columns = [*head.split(","), "proven", "suitable", "suitable of accepted, %"]
    columns += ["duration, s (mean)", "turning back (mean)", "tip error, mm (median)", "95 %"]
    columns += ["stray, mm (95 %)", "torque of limits, % (95 %)"]
    arms = [row["arm"] for row in results["rows"]]
    rows = sorted(results["rows"], key=lambda row: arms.index(row["arm"]))
    return words + "\n" + markdown(columns, [_line(row) for row in rows])


def _line(row: Row) -> list[str]:
    return [
        *(row["arm"], row["family"], label(row["planner"]), f"{row['payload']:g}"),
        *(str(row[name]) for name in ("accepted", "found", "timed", "touched", "swings")),
        str(row["timed"] - row["settled"]),
        *(str(row[name]) for name in ("proven", "suitable")),
        interval(row["suitable_share"], ".1f", 100),
        cell(row["duration"], ".2f"),
        cell(row["turns"], ".1f"),
        *(cell(row["tip_error"], ".1f", 1e3, key) for key in ("median", "p95")),
        cell(row["stray"], ".1f", 1e3, "p95"),
        cell(row["torque_use"], ".0f", 100, "p95"),
    ]


def verdict(results: Row) -> str:
    """Whether on each arm more motions are suitable than the paper's six of ten, by the interval,
    and at least as many as RRT-Connect's."""
    rows, findings, beside = results["rows"], [], []
    paper = REAL_ARM["gnn"]
    for arm in dict.fromkeys(row["arm"] for row in rows):
        ours, theirs = (_together(rows, planner, arm=arm) for planner in (OWN, RIVAL))
        if ours["share"] is None:
            continue
        own, other = ours["share"], theirs["share"]
        text = f"{arm}: {interval(own, '.1f', 100)} % of {ours['accepted']} motions are suitable"
        findings.append(Finding(own["low"] > paper["suitable"], text))
        if ours["rows"] == theirs["rows"] and other is not None:  # of the same problems
            text = f"{arm}: RRT-Connect's, simplified, {interval(other, '.1f', 100)} %"
            findings.append(Finding(own["mean"] >= other["mean"], text))
        else:
            beside.append(f"RRT-Connect is not measured on all that guided is on {arm}.")
    network = _together(rows, PAPER)
    if network["share"] is not None:
        beside += [
            f"Of the paper's network, found {network['found']} of {network['accepted']}, "
            f"{interval(network['share'], '.1f', 100)} % are suitable; it states "
            f"{100 * paper['found']:.0f} % found and {100 * paper['suitable']:.0f} % suitable."
        ]
    return judge(*findings, beside=beside)


EXPERIMENT = Experiment(
    name="real_arm",
    title="Carried out by an arm",
    claim="Planned motions can be carried out by an arm that is not quite as its model, more often "
    "than the paper's.",
    config=RealArmConfig,
    quick={"num_problems": 3, "families": ("paper",), "payloads": (0.0, 1.0)},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
