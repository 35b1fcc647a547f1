"""What the experiments share: planners measured on problem sets, over seeds, with intervals.

An experiment asks for cases (`EvaluateConfig`s). Each is evaluated for every seed by
`gnnjax.evaluate`, whose files in `runs/` hold every problem; a run that was cut off goes on from
them. What is kept are summaries over problems and seeds, in `results/`.
"""

import dataclasses
import functools
import json
import shlex
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.files import atomic_write
from gnnjax.generate import GenerateConfig, generate
from gnnjax.measure.machine import describe_machine
from gnnjax.measure.rows import QUANTITIES
from gnnjax.planning.planner import make_planner

# Of the files in `results/`; raised when what they hold changes its meaning.
FORMAT = 1

SEEDS = (0, 1, 2)
_RESAMPLES = 2000  # of the bootstrap

SHARES = ("success", "success_first_roadmap", "certified")


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
    """Where the results of single problems go."""
    results: Path | None = None
    """Where the JSON and the figure go; by default results, and runs/quick with --quick."""

    @property
    def out(self) -> Path:
        """The folder of the JSON and the figure: a quick look leaves the real results alone."""
        return self.results or Path("runs/quick" if self.quick else "results")


def problem_set(
    config: ExperimentConfig, robot: str, *, family: str = "paper", num_problems: int = 300
) -> Path:
    """The file of a test set, generated if it is missing."""
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
    return path


def problem_sets(config: ExperimentConfig, robot: str, num_problems: int) -> dict[str, Path]:
    """The test set, and the public problems of the same arm if they are there."""
    sets = {"test": problem_set(config, robot, num_problems=num_problems)}
    public = config.data / f"{Path(robot).stem}_public.npz"
    return sets | ({"public": public} if public.exists() else {})


def measure(case: EvaluateConfig, seeds: Sequence[int], runs: Path) -> dict[str, Any]:
    """Evaluates a case for every seed and sums up; what is done already is read from `runs`.

    Returns:
        settings, the command of the first seed, the machine, and the summary of `summarize_seeds`.
    """
    made = [run_seed(case, seed, runs) for seed in seeds]
    settings = {k: v for k, v in made[0]["settings"].items() if k != "seed"}
    return {
        "settings": settings | {"seeds": list(seeds)},
        "command": command(case),
        "machine": made[0]["machine"],
        "summary": summarize_seeds([results["problems"] for results in made]),
    }


def run_seed(case: EvaluateConfig, seed: int, runs: Path) -> dict[str, Any]:
    """All results of one seed, problem by problem."""
    case = dataclasses.replace(case, seed=seed, json=runs / f"{slug(case)}_seed{seed}.json")
    settings = dataclasses.replace(case, problems=Path(), json=Path(), seed=0, num_problems=None)
    return evaluate(case, _planner(settings))


@functools.cache
def _planner(settings: EvaluateConfig) -> Any:
    """One planner for all seeds and sets, so that it is compiled once."""
    return make_planner(load_robot(settings.robot), settings)


def slug(case: EvaluateConfig) -> str:
    """A file name that differs where settings do."""
    default = {field.name: field.default for field in dataclasses.fields(EvaluateConfig)}
    parts = [case.problems.stem, case.planner.replace(":", "-"), str(case.num_nodes)]
    for name, value in dataclasses.asdict(case).items():
        known = name in ("problems", "json", "planner", "num_nodes", "seed", "robot")
        if not known and value != default[name]:
            text = str(value).replace("/", "-").strip("-.")
            parts.append(f"{name.replace('_', '-')}-{text}")
    return "_".join(parts)


def command(case: EvaluateConfig) -> str:
    """The command line that evaluates a case."""
    words = ["python", "-m", "gnnjax.evaluate"]
    for field in dataclasses.fields(EvaluateConfig):
        value = getattr(case, field.name)
        if field.name == "json":
            value = Path("out.json")
        if value == field.default or field.name == "seed":
            continue
        option = field.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            words += [f"--{option}", str(value)]
    return shlex.join(words)


def summarize_seeds(
    per_seed: Sequence[Sequence[dict]], keep: Callable[[int], bool] = lambda index: True
) -> dict[str, Any]:
    """Sums up the same problems planned with several seeds: all of them, and the hard ones.

    Intervals are 95 % bootstrap intervals over problems, each problem with all its seeds.

    Args:
        per_seed: rows of `gnnjax.evaluate`, a list a seed.
        keep: which problems count, by index.
    """
    valid = np.array([row["valid"] and keep(row["index"]) for row in per_seed[0]])
    hard = np.array([row["hard"] for row in per_seed[0]])
    summary: dict[str, Any] = {
        "num_problems": len(valid),
        "num_seeds": len(per_seed),
        "num_invalid": sum(not row["valid"] for row in per_seed[0]),
    }
    table = _columns(per_seed)
    for stratum, chosen in {"all": valid, "hard": valid & hard}.items():
        solved = table["success"][:, chosen]
        part: dict[str, Any] = {"num_problems": int(chosen.sum())}
        for name in (*SHARES, *QUANTITIES):
            values = table[name][:, chosen]
            counts = np.ones_like(solved) if QUANTITIES.get(name, True) else solved
            # NaN: a planner that has no such quantity.
            part[name] = statistics(values, counts.astype(bool) & ~np.isnan(values))
        summary[stratum] = part
    return summary


def _columns(per_seed: Sequence[Sequence[dict]]) -> dict[str, np.ndarray]:
    """Every quantity as `[seeds, problems]`."""
    rows = [
        [{**row, "success_first_roadmap": row["success"] and row["roadmaps"] == 1} for row in seed]
        for seed in per_seed
    ]
    return {
        name: np.array([[np.nan if r[name] is None else float(r[name]) for r in s] for s in rows])
        for name in (*SHARES, *QUANTITIES)
    }


def statistics(values: np.ndarray, counts: np.ndarray) -> dict[str, Any] | None:
    """Mean with its 95 % interval, spread, median and 95th percentile.

    Args:
        values: `[seeds, problems]`.
        counts: which of them count.
    """
    chosen = values[counts]
    if not chosen.size:
        return None
    sums, weights = np.where(counts, values, 0.0).sum(axis=0), counts.sum(axis=0)
    rows = np.random.default_rng(0).integers(len(sums), size=(_RESAMPLES, len(sums)))
    with np.errstate(invalid="ignore"):  # a resample without a solved problem
        means = sums[rows].sum(axis=1) / weights[rows].sum(axis=1)
    low, high = np.nanquantile(means, [0.025, 0.975])
    return {
        "mean": float(chosen.mean()),
        "low": float(low),
        "high": float(high),
        "std": float(chosen.std()),
        "median": float(np.median(chosen)),
        "p95": float(np.quantile(chosen, 0.95)),
    }


def save_results(
    config: ExperimentConfig, name: str, claim: str, rows: Iterable[dict[str, Any]], **more: Any
) -> list[dict[str, Any]]:
    """Writes `results/NAME.json` anew after every row, as they come.

    Args:
        config: says where.
        name: of the experiment.
        claim: what it tests.
        rows: made one after the other.
        more: further entries of the file.
    """
    done: list[dict[str, Any]] = []
    head = {"format": FORMAT, "experiment": name, "claim": claim, "machine": describe_machine()}
    for row in rows:
        done.append(row)
        # A line a row, so that a change shows which rows changed.
        lines = ",\n".join(json.dumps(each, allow_nan=False) for each in done)
        text = f'{json.dumps({**head, **more}, allow_nan=False)[:-1]}, "rows": [\n{lines}\n]}}\n'
        atomic_write(
            config.out / f"{name}.json", lambda f, t=text: f.write_text(t, encoding="utf-8")
        )
    return done


def load_results(path: Path) -> dict[str, Any]:
    """Reads a file of `save_results`.

    Raises:
        InputError: no such file, or one of another format.
    """
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
        found = results["format"]
    except FileNotFoundError:
        raise InputError(f"no results {str(path)!r}; run python -m experiments.run_all") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{str(path)!r} holds no results; remove it and run again") from None
    if found != FORMAT:
        raise InputError(
            f"{str(path)!r} holds results of format {found!r}, this version reads {FORMAT}; "
            "remove it and run again"
        )
    return results
