"""Claim: motions keep their limits, take as long as toppra's along the same curve, and less than
those along RRT-Connect's simplified paths.

    python -m experiments.motions

Test problems of each arm are planned by the guided planner and by RRT-Connect, whose paths OMPL
simplifies; both are then rounded and timed by the same code, under the limits of velocity,
acceleration and torque of the arm's model. Each motion is looked at at ten times as many moments as
its grid has; torques are MuJoCo's. Durations are compared on problems that both have a motion for.
toppra (Pham and Pham, 2018) times curves without stops under the limits of velocity and
acceleration alone, on a grid twice as fine, and so do we.

Motions a second are those of the guided planner's paths in batches, in one process, on the wall
clock: rounding, certificates of the curves, timing. Everything is computed once before, untimed.
"""

import dataclasses
import functools
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from experiments.by_toppra import duration_by_toppra
from experiments.cases import classical_case
from experiments.measure import ExperimentConfig
from experiments.motions_table import OWN, RIVAL, draw, table, verdict
from experiments.record import Experiment, Measurement, main
from experiments.results import Row
from experiments.turns import folder_of, kept
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.generate import GenerateConfig, generate
from gnnjax.measure.rows import straight_line_blocked
from gnnjax.measure.statistics import describe
from gnnjax.planning.load import make_planner
from gnnjax.planning.query import check_queries
from gnnjax.problems.problem import Problem
from gnnjax.problems.shards import load_problems
from gnnjax.scene.scene import Scene
from gnnjax.trajectory.limits import ANY_TORQUE, Limits, limits_of
from gnnjax.trajectory.states import largest_use
from gnnjax.trajectory.trajectory import Trajectory, time_path, time_paths


@dataclasses.dataclass(frozen=True)
class MotionsConfig(ExperimentConfig):
    """Motions along the paths of planners; of the seeds, the first alone."""

    arms: tuple[str, ...] = ("kuka_iiwa14", "franka_panda", "kinova_gen3")
    """The arms."""
    num_problems: int = 1700
    """Problems of each."""
    batch: int = 256
    """Motions that are found at once."""
    singles: int = 100
    """Motions that are found one by one, too."""
    compared: int = 200
    """Motions that toppra times, too."""
    time_limit: float = 1.0
    """Seconds after which RRT-Connect gives a problem up."""
    velocity: float | None = None
    """Of all joints, rad/s or m/s; by default the model's."""
    acceleration: float | None = None
    """Of all joints, rad/s^2 or m/s^2; by default the model's."""


def measurement(config: MotionsConfig) -> Measurement:
    """A row an arm."""
    names = ("num_problems", "batch", "singles", "compared", "time_limit")
    names += ("velocity", "acceleration")
    settings = {name: getattr(config, name) for name in names} | {"seed": config.seeds[0]}
    return Measurement(_rows(config, settings), {"settings": settings})


def _rows(config: MotionsConfig, settings: Row) -> Iterator[Row]:
    for arm in (config.robot,) if config.robot else config.arms:
        stem = Path(arm).stem
        path = config.data / f"{stem}_motions{'_quick' if config.quick else ''}.npz"
        if not path.exists():
            num = config.num_problems
            generate(GenerateConfig(split="test", robot=arm, num_problems=num, out=path))
        folder = folder_of(config.runs, f"motions_{stem}", settings, path)
        yield kept(folder / "row.json", functools.partial(_measure, config, arm, path))


def _measure(config: MotionsConfig, arm: str, path: Path) -> Row:
    robot, seed = load_robot(arm), config.seeds[0]
    limits = limits_of(robot, velocity=config.velocity, acceleration=config.acceleration)
    problems = load_problems(path, robot).problems
    accepted = np.array([reason is None for reason in check_queries(robot, problems)])
    problems = jax.tree.map(lambda x: np.asarray(x)[accepted], problems)
    hard = np.asarray(straight_line_blocked(robot, "fused", problems))
    durations, planners = {}, {}
    for planner in (OWN, RIVAL):
        case = dataclasses.replace(classical_case(path, arm, planner), seed=seed)
        if planner == RIVAL:
            case = dataclasses.replace(case, time_limit=config.time_limit)
        plans = make_planner(robot, case).plan_batch(problems, seed=seed)
        ids = np.flatnonzero([plan.success for plan in plans])
        paths = [plans[i].path for i in ids]
        found = _in_batches(config, robot, problems, ids, paths, proven=planner == OWN)
        good = [motion for motion in found if motion.success]
        durations[planner] = np.full(len(plans), np.nan)
        durations[planner][ids] = [m.duration if m.success else np.nan for m in found]
        planners[planner] = {
            "paths": len(ids),
            "motions": len(good),
            "reasons": sorted({motion.reason for motion in found if not motion.success}),
            "certified": sum(motion.certified for motion in good),
            "stops": sum(motion.stops for motion in good),
            "largest_use": max(largest_use(robot, limits, motion) for motion in good),
        }
        print(f"{robot.name}, {planner}: {len(good)} motions", flush=True)
        if planner == OWN:
            clock = _clock(config, robot, problems, ids, paths)
            beside = _beside_toppra(config, robot, limits, problems, ids, paths)
    both = np.isfinite(durations[OWN]) & np.isfinite(durations[RIVAL])
    strata = {"all": both, "hard": both & hard}
    compared = {
        name: {"num": int(rows.sum())}
        | {planner: float(durations[planner][rows].mean()) for planner in durations}
        for name, rows in strata.items()
        if rows.any()
    }
    return {
        "arm": robot.name,
        "num_problems": len(hard),
        "planners": planners,
        "durations": compared,
        **clock,
        "toppra": beside,
    }


def _scenes(problems: Problem, rows: np.ndarray | int) -> Scene:
    return jax.tree.map(lambda x: x[rows], problems.scene)


def _in_batches(
    config: MotionsConfig,
    robot: Robot,
    problems: Problem,
    ids: np.ndarray,
    paths: list[np.ndarray],
    **options: bool | float,
) -> list[Trajectory]:
    """Motions along paths of some problems."""
    found, given = [], _given(config) | options
    for first in range(0, len(ids), config.batch):
        some = slice(first, first + config.batch)
        found += time_paths(robot, _scenes(problems, ids[some]), paths[some], **given)
    return found


def _given(config: MotionsConfig) -> Row:
    return {"velocity": config.velocity, "acceleration": config.acceleration}


def _clock(
    config: MotionsConfig, robot: Robot, problems: Problem, ids: np.ndarray, paths: list
) -> Row:
    """How fast motions are found, in batches and one by one; batches were compiled before."""
    begin, busy = time.perf_counter(), time.process_time()
    _in_batches(config, robot, problems, ids, paths, proven=True)
    wall, busy = time.perf_counter() - begin, time.process_time() - busy
    lone = []
    for turn in range(2):  # the first compiles
        lone = []
        for i, path in zip(ids[: config.singles], paths, strict=False):
            scene = _scenes(problems, i)
            begin = time.perf_counter()
            time_path(robot, scene, path, proven=True, **_given(config))
            lone.append(time.perf_counter() - begin)
        print(f"{robot.name}: one by one, turn {turn + 1}", flush=True)
    return {"per_s": len(ids) / wall, "cores": busy / wall, "lone_s": describe(np.array(lone))}


def _beside_toppra(
    config: MotionsConfig,
    robot: Robot,
    limits: Limits,
    problems: Problem,
    ids: np.ndarray,
    paths: list,
) -> Row:
    """Durations over toppra's, of the first motions without stops; and who finds none where the
    other does."""
    num = 2 * config.compared
    found = _in_batches(
        config, robot, problems, ids[:num], paths[:num], proven=True, torque=ANY_TORQUE
    )
    going = [motion for motion in found if motion.cost > 0 and not motion.stops]
    ratios, failed, theirs_failed = [], 0, 0
    for motion in going[: config.compared]:
        theirs = duration_by_toppra(jax.tree.map(np.asarray, motion.curve), limits)
        failed += theirs is not None and not motion.success
        theirs_failed += theirs is None and motion.success
        if theirs is not None and motion.success:
            ratios.append(motion.duration / theirs)
    return {"ratios": ratios, "failed": failed, "theirs_failed": theirs_failed}


EXPERIMENT = Experiment(
    name="motions",
    title="Motions in time",
    claim="Motions keep their limits, take as long as toppra's along the same curve, and less than "
    "those along RRT-Connect's simplified paths; a core finds 250 a second, and one in 20 ms.",
    config=MotionsConfig,
    quick={"num_problems": 3, "singles": 2, "compared": 2, "batch": 4},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)


if __name__ == "__main__":
    main(EXPERIMENT)
