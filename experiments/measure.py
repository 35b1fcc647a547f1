"""What the experiments share: planners measured on problem sets, over seeds.

An experiment asks for cases (`EvaluateConfig`s). Each is evaluated for every seed by
`gnnjax.evaluate`, whose files in `runs/` hold every problem; a run that was cut off goes on from
them, and experiments share them. Those of other code lie in folders of their own. What is kept are
summaries over problems and seeds, in `results/`.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

from experiments.commands import command_line
from experiments.statistics import column, statistics, summarize_seeds
from experiments.turns import code_digest
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, evaluate, planner_for
from gnnjax.generate import GenerateConfig, generate
from gnnjax.problems.shards import load_problems

SEEDS = (0, 1, 2)


@dataclasses.dataclass(frozen=True)
class ExperimentConfig:
    """Options that all experiments have."""

    quick: bool = False
    """A few problems, one seed and one roadmap size, to see that everything runs."""
    robot: str | None = None
    """Another arm than the experiment's own, for a quick look: name, or path of an MJCF."""
    seeds: tuple[int, ...] = SEEDS
    """Seeds of the roadmaps and of the randomized planners."""
    data: Path = Path("data")
    """Where problem sets are, and are generated if they are missing."""
    runs: Path = Path("runs/evaluate")
    """Where the results of single problems go, in a folder for each version of the code."""
    results: Path | None = None
    """Where the JSON and the figure go; by default results, and runs/quick with --quick."""

    @property
    def out(self) -> Path:
        """The folder of the JSON and the figure: a quick look leaves the real results alone."""
        return self.results or Path("runs/quick" if self.quick else "results")


class MissingProblems(InputError):
    """Problems that others publish, and that nothing here can make, are not there."""


def problem_set(
    config: ExperimentConfig, robot: str, *, family: str = "paper", num_problems: int = 300
) -> Path:
    """The file of a test set, generated if it is missing.

    Raises:
        InputError: the file that is there holds fewer problems.
    """
    stem = Path(robot).stem
    name = stem if family == "paper" else f"{stem}_{family}"
    path = config.data / f"{name}_test{'_quick' if config.quick else ''}.npz"
    if not path.exists():
        family_option: dict[str, Any] = {} if family == "paper" else {"family": family}
        generate(
            GenerateConfig(
                split="test", robot=robot, num_problems=num_problems, out=path, **family_option
            )
        )
    held = len(load_problems(path, load_robot(robot)))
    if held < num_problems and not config.quick:
        raise InputError(
            f"{str(path)!r} holds {held} problems, and {num_problems} are wanted; remove it"
        )
    return path


def problem_sets(config: ExperimentConfig, robot: str, num_problems: int) -> dict[str, Path]:
    """The test set, and the public problems of the same arm if they are there."""
    sets = {"test": problem_set(config, robot, num_problems=num_problems)}
    public = config.data / f"{Path(robot).stem}_public.npz"
    return sets | ({"public": public} if public.exists() else {})


def measure(config: ExperimentConfig, case: EvaluateConfig) -> dict[str, Any]:
    """Evaluates a case for every seed and sums up; what is done already is read from `runs`.

    Returns:
        settings, the command of the first seed, the machine, and the summary of `summarize_seeds`.
    """
    made = [_run_seed(case, seed, config.runs) for seed in config.seeds]
    settings = {k: v for k, v in made[0]["settings"].items() if k != "seed"}
    return {
        "settings": settings | {"seeds": list(config.seeds)},
        "command": command(case),
        "machine": made[0]["machine"],
        "summary": summarize_seeds([results["problems"] for results in made]),
    }


def measure_problems(config: ExperimentConfig, case: EvaluateConfig) -> list[list[dict]]:
    """The same, problem by problem: rows of `gnnjax.evaluate`, a list a seed."""
    return [_run_seed(case, seed, config.runs)["problems"] for seed in config.seeds]


def difference(config: ExperimentConfig, ours: EvaluateConfig, theirs: EvaluateConfig) -> Any:
    """How much more edge checks and success a case has, on the same problems and roadmaps."""
    problems = [measure_problems(config, case) for case in (ours, theirs)]
    valid = column(problems[0], lambda row: row["valid"]).astype(bool)
    found = {}
    for name in ("edge_checks", "success"):
        # Invalid problems have no numbers.
        ours_, theirs_ = (column(rows, lambda row, name=name: row[name] or 0) for rows in problems)
        found[name] = statistics(ours_ - theirs_, valid)
    return found


def _run_seed(case: EvaluateConfig, seed: int, runs: Path) -> dict[str, Any]:
    """All results of one seed."""
    path = runs / code_digest()[:8] / f"{slug(case)}_seed{seed}.json"
    case = dataclasses.replace(case, seed=seed, json=path)
    settings = dataclasses.replace(case, problems=Path(), json=Path(), seed=0, num_problems=None)
    return evaluate(case, _planner(settings))


# One planner for all seeds and sets, so that it is compiled once.
_planner = functools.lru_cache(maxsize=4)(planner_for)


# Settings that file names tell in other ways, and those that change no row.
_UNTOLD = "problems json planner num_nodes seed robot cluster keep_parts figure beside".split()


def slug(case: EvaluateConfig) -> str:
    """A file name that differs where settings do."""
    default = {field.name: field.default for field in dataclasses.fields(EvaluateConfig)}
    parts = [case.problems.stem, case.planner.replace(":", "-"), str(case.num_nodes)]
    for name, value in dataclasses.asdict(case).items():
        if name not in _UNTOLD and value != default[name]:
            text = str(value).replace("/", "-").strip("-.")
            parts.append(f"{name.replace('_', '-')}-{text}")
    return "_".join(parts)


def command(case: EvaluateConfig) -> str:
    """The command line that evaluates a case."""
    return command_line("evaluate", dataclasses.replace(case, json=Path("out.json")), skip=["seed"])
