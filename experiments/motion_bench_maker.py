"""Claim: MotionBenchMaker's problems are solved, at a lower cost than by RRT-Connect, simplified.

    python -m experiments.motion_bench_maker --folder problems/    # YAML, as they are published
    python -m experiments.motion_bench_maker --problems problems.npz

The problems are those of Chamzas et al., "MotionBenchMaker: A Tool to Generate and Benchmark
Motion Planning Datasets" (2021): a folder a scene, with a MoveIt planning scene and request a
problem. They are not shipped.

The guided planner plans the problems of a scene one at a time, for the times of single queries,
and all at once, for plans a second; those of all scenes in one pool, too. OMPL's planners test with
the same kernel and plan one problem after the other, in processes with a core each; the clock runs
for all of these together. Everything is planned once before, untimed, as compilation is not part of
it. What was planned is kept in `runs/`.

Total times hold the check of the query, and the guided planner's the certificate; OMPL's paths are
certified afterwards. VAMP's costs, where a set has them, are its authors' own.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path

import jax
import numpy as np

from experiments.by_scene import ALL, OWN, PUBLISHED, RIVALS, draw, of_planner, table
from experiments.cases import classical_case
from experiments.contenders import (
    in_pools,
    in_processes,
    planner_of,
    problems_of,
    processes_of,
    start_workers,
)
from experiments.measure import ExperimentConfig, MissingProblems, problem_set
from experiments.moveit_folder import problems_of_folder
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.style import label
from experiments.turns import Columns, folder_of, joined, kept, per_s, summarize, summarize_turn
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import ProblemSet
from gnnjax.problems.shards import load_problems


@dataclasses.dataclass(frozen=True)
class MotionBenchMakerConfig(ExperimentConfig):
    """Problems of MotionBenchMaker, scene by scene; of the seeds, the first alone."""

    folder: Path | None = None
    """Folder with the published YAML files; what they hold is kept in data/ as a problem set."""
    problems: Path | None = None
    """The problem set; by default data/ROBOT_motion_bench_maker.npz."""
    num_problems: int | None = None
    """Only the first so many problems of each scene."""
    hold: tuple[tuple[str, float], ...] = ()
    """Joints that are held, and where, rad or m: finger_joint_1 0.065 finger_joint_2 0.065."""
    time_limit: float = 1.0
    """Seconds after which OMPL's planners give a problem up."""
    processes: int = 2
    """Processes of OMPL's planners, and of ours where a scene's problems are planned at once."""


def measurement(config: MotionBenchMakerConfig) -> Measurement:
    """Rows of all planners, in each scene and in all."""
    if config.processes < 1 or (config.num_problems is not None and config.num_problems < 1):
        raise InputError("processes and num_problems must be at least 1")
    robot = config.robot or "franka_panda"
    path = _problems(config, robot)
    arm = load_robot(robot, hold=dict(config.hold))
    problems = load_problems(path, arm)
    rows = _rows_by_scene(problems, path, config.num_problems)
    settings = {
        "robot": Path(robot).stem,
        "hold": dict(config.hold),
        "set": path.stem,
        "problems": {scene: len(chosen) for scene, chosen in rows.items()},
        "time_limit": config.time_limit,
        "processes": config.processes,
        "seed": config.seeds[0],
    }
    told = {name: problems.extras[name] for name in PUBLISHED if name in problems.extras}
    name = f"motion_bench_maker_{path.stem}"
    folder = folder_of(config.runs, name, settings, path, arm.path)

    def case(planner: str) -> EvaluateConfig:
        limit = np.inf if planner == OWN else config.time_limit
        made = classical_case(path, robot, planner)
        chosen = {"time_limit": limit, "seed": config.seeds[0], "hold": config.hold}
        return dataclasses.replace(made, **chosen)

    return Measurement(_rows(config, case, rows, told, folder), {"settings": settings})


def _problems(config: MotionBenchMakerConfig, robot: str) -> Path:
    """The file of the set, made of the folder that is named."""
    if config.folder is not None and config.problems is not None:
        raise InputError("--folder and --problems are both given; name one of them")
    path = config.data / f"{Path(robot).stem}_motion_bench_maker.npz"
    if config.problems is not None:
        return config.problems
    if config.folder is not None:
        if not config.folder.is_dir():
            raise InputError(f"no folder {str(config.folder)!r}; check the path")
        held = load_robot(robot, hold=dict(config.hold))
        save_problems(path, problems_of_folder(config.folder, held))
    if path.exists():
        return path
    if config.quick:
        return problem_set(config, robot, num_problems=4)
    raise MissingProblems(
        f"no problem set {str(path)!r}; name the folder of MotionBenchMaker's published problems "
        "(--folder) once"
    )


def _rows_by_scene(problems: ProblemSet, path: Path, most: int | None) -> dict[str, np.ndarray]:
    """The problems of each scene; a set that names no scenes has one."""
    names = problems.extras.get("scene", np.full(len(problems), path.stem))
    if names.shape != (len(problems),):
        raise InputError(
            f"scene of problem set {str(path)!r} has shape {names.shape}; give a name a problem"
        )
    return {str(name): np.flatnonzero(names == name)[:most] for name in np.unique(names)}


def _rows(
    config: MotionBenchMakerConfig,
    case: Callable[[str], EvaluateConfig],
    rows: dict[str, np.ndarray],
    told: dict[str, np.ndarray],
    folder: Path,
) -> Iterator[Row]:
    turns: dict[str, dict[str, list[Columns]]] = {}
    with start_workers(config.processes) as workers:
        for scene, chosen in rows.items():
            for planner in (OWN, *RIVALS):
                path = folder / f"{scene}_{planner.replace(':', '-')}.json"
                plan = functools.partial(_plan, workers, case(planner), chosen, config.processes)
                taken = kept(path, plan)
                turns.setdefault(planner, {})[scene] = taken
                print(f"{scene}: {label(planner)}, {per_s(taken[-1]):.1f} plans/s", flush=True)
                yield _row(scene, planner, [taken], [turns[OWN][scene]])
    every = {ALL: np.concatenate(list(rows.values()))}
    pool = functools.partial(_plan_at_once, case(OWN), every[ALL], config.processes)
    together = kept(folder / f"pool_{OWN}.json", pool)
    print(f"{ALL}: {label(OWN)}, {per_s(together):.1f} plans/s", flush=True)
    for planner, taken in turns.items():
        row = _row(ALL, planner, list(taken.values()), list(turns[OWN].values()))
        yield row | (_clocked(together) if planner == OWN else {})
    # Of the same problems, those that the guided planner solves.
    solved = {
        scene: chosen[np.array(turns[OWN][scene][0]["success"], bool)]
        for scene, chosen in rows.items()
    }
    solved[ALL] = np.concatenate(list(solved.values()))
    for scene, chosen in (rows | every).items():
        for name, values in told.items():
            yield {
                "scene": scene,
                "planner": name,
                "num_problems": len(chosen),
                "cost": {"mean": float(values[chosen].mean())},
                "cost_where_guided_solves": _mean(values[solved[scene]]),
            }


def _plan(
    workers: Executor, case: EvaluateConfig, chosen: np.ndarray, processes: int
) -> list[Columns]:
    """The turn that is told of, and for ours another with all problems at once."""
    if case.is_classical:
        in_processes(workers, case, chosen)  # compiles
        return [summarize_turn(in_processes(workers, case, chosen))]
    own = jax.tree.map(lambda x: x[chosen], problems_of(case))
    alone = functools.partial(in_pools, planner_of(case), own, 1, case.seed)
    alone()
    return [summarize_turn(alone()), _plan_at_once(case, chosen, processes)]


def _plan_at_once(case: EvaluateConfig, chosen: np.ndarray, processes: int) -> Columns:
    """A turn in one pool, in processes that share it."""
    own = jax.tree.map(lambda x: x[chosen], problems_of(case))
    planner = processes_of(case, processes)
    in_pools(planner, own, len(chosen), case.seed)
    return summarize_turn(in_pools(planner, own, len(chosen), case.seed))


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None


def _row(scene: str, planner: str, taken: list[list[Columns]], ours: list[list[Columns]]) -> Row:
    """Of a planner's turns in one or more scenes; the last of each is that of the clock.

    Costs are compared on what both it and the guided planner solve: who fails at the hard ones has
    the lower mean.
    """
    first, own = (joined([turns[0] for turns in each]) for each in (taken, ours))
    clock = joined([turns[-1] for turns in taken])
    row = {"scene": scene, "planner": planner} | summarize([first])
    row["certified"] = float(np.mean(first["certified"]))
    both = np.logical_and(first["success"], own["success"])
    costs = [_mean(np.array(each["cost"], float)[both]) for each in (first, own)]
    row["both"] = {"num": int(both.sum()), "cost": costs[0], "guided": costs[1]}
    return row | _clocked(clock)


def _clocked(turn: Columns) -> Row:
    """What the clock says of a turn."""
    return {"per_s": per_s(turn), "cores": turn["cores"]}


def verdict(results: Row) -> str:
    """Whether all problems are solved, how many are valid, and what the paths cost."""
    ours = of_planner(results, OWN)[ALL]
    num, valid = ours["num_problems"], ours["num_accepted"]
    solved = round(ours["success_of_all"] * num)
    findings = [Finding(valid == num, f"{valid} of {num} problems have both ends free")]
    if valid:
        findings.append(Finding(solved == valid, f"{solved} of these {valid} are solved"))
    both = of_planner(results, "ompl:rrt_connect@simplified")[ALL]["both"]
    if both["num"]:
        text = f"on the {both['num']} that both solve the mean cost is {both['guided']:.2f}, that "
        text += f"of RRT-Connect, simplified, {both['cost']:.2f}"
        findings.append(Finding(both["guided"] < both["cost"], text))
    beside = []
    vamp = of_planner(results, "vamp_simplified_cost")
    if vamp and vamp[ALL]["cost_where_guided_solves"] is not None:
        mean = vamp[ALL]["cost_where_guided_solves"]
        beside = [f"On what guided solves, VAMP's published mean cost, simplified, is {mean:.2f}."]
    return judge(*findings, beside=beside)


EXPERIMENT = Experiment(
    name="motion_bench_maker",
    title="MotionBenchMaker",
    claim="MotionBenchMaker's problems are solved, at a lower cost than by RRT-Connect, "
    "simplified.",
    config=MotionBenchMakerConfig,
    quick={"num_problems": 3, "processes": 1},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)


if __name__ == "__main__":
    main(EXPERIMENT)
