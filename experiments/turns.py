"""What contenders needed for the same problems, turn by turn: kept in files, and summed up."""

import functools
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gnnjax
from experiments.contenders import Turn
from experiments.results import Row
from gnnjax.arm.shipped import assets_dir
from gnnjax.files import atomic_write, check_target
from gnnjax.measure.statistics import describe

Columns = dict[str, Any]  # a turn as it is kept: the clock, and a list for each quantity


def folder_of(runs: Path, name: str, settings: Any, *files: Path) -> Path:
    """Where is kept what this very code has measured with settings and files; what others have
    measured, or earlier versions, lies elsewhere."""
    contents = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    told = json.dumps([settings, contents, code_digest()]).encode()
    return runs / f"{name}_{hashlib.sha256(told).hexdigest()[:8]}"


@functools.cache
def code_digest() -> str:
    """The digest of what measures: the package with its weights, the experiments, and the arms."""
    package, own = Path(gnnjax.__file__).parent, Path(__file__).parent
    return _digest_of([package, own, assets_dir()])


def _digest_of(folders: list[Path]) -> str:
    """The digest of all files of some folders and those in them, with their names."""
    found = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                name, content = path.relative_to(folder.parent).as_posix(), path.read_bytes()
                found.update(f"{name}:{len(content)}:".encode() + content)
    return found.hexdigest()


def kept(path: Path, measure: Callable[[], Any]) -> Any:
    """What an earlier run has measured, or else this one measures and keeps."""
    if not path.exists():
        check_target(path)
        text = json.dumps(measure(), allow_nan=False) + "\n"
        atomic_write(path, lambda file: file.write_text(text, encoding="utf-8"))
    return json.loads(path.read_text(encoding="utf-8"))


def summarize_turn(turn: Turn) -> Columns:
    """A turn as it is kept; None for what a problem has not."""
    plans = [plan if plan.valid else None for plan in turn.plans]
    return {
        "wall_s": turn.wall_s,
        "cores": turn.cores,
        "accepted": [plan is not None for plan in plans],
        "success": [plan is not None and plan.success for plan in plans],
        "certified": [plan is not None and plan.certified for plan in plans],
        "cost": [plan.cost if plan and plan.success else None for plan in plans],
        "configuration_checks": [plan and plan.configuration_checks for plan in plans],
        "total_time_s": [plan and plan.total_time_s for plan in plans],
    }


def joined(turns: list[Columns]) -> Columns:
    """Turns over different problems, one after the other."""
    walls = [turn["wall_s"] for turn in turns]
    lists = {
        name: [x for turn in turns for x in turn[name]]
        for name, value in turns[0].items()
        if isinstance(value, list)
    }
    cores = float(np.average([turn["cores"] for turn in turns], weights=walls))
    return lists | {"wall_s": sum(walls), "cores": cores}


def per_s(turn: Columns) -> float:
    """Accepted problems a second."""
    return turn["accepted"].count(True) / turn["wall_s"]


def summarize(turns: list[Columns]) -> Row:
    """Sums up a contender's turns over the same problems."""

    def column(name: str) -> np.ndarray:
        return np.array([value for turn in turns for value in turn[name] if value is not None])

    def described(name: str) -> dict[str, float] | None:
        values = column(name)
        return describe(values) if len(values) else None

    accepted, success, certified = map(column, ("accepted", "success", "certified"))
    return {
        "num_problems": len(turns[0]["accepted"]),
        "num_accepted": turns[0]["accepted"].count(True),
        "per_s": [per_s(turn) for turn in turns],
        "cores": [turn["cores"] for turn in turns],
        "success_of_all": float(success.mean()),
        "success": float(success[accepted].mean()) if accepted.any() else None,
        "certified_paths": float(certified[success].mean()) if success.any() else None,
        "cost": described("cost"),
        "configuration_checks": described("configuration_checks"),
        "total_time_s": described("total_time_s"),
    }
