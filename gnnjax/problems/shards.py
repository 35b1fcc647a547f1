"""Larger problem sets: folders of problem files, with a manifest that says what is in them."""

import bisect
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief
from gnnjax.files import as_json, atomic_write, code_version
from gnnjax.problems.file import load_file, save_problems
from gnnjax.problems.problem import ProblemSet
from gnnjax.scene.batches import same_clouds
from gnnjax.scene.scene import pad_scene

MANIFEST = "manifest.json"  # of a folder of shards


def load_problems(path: str | Path, robot: Robot) -> ProblemSet:
    """Reads a problem set for `robot`, padded to a box bucket.

    Args:
        path: an `.npz`, or a folder of shards whose checksums are then verified.
        robot: the arm that the problems must be for.

    Raises:
        InputError: no such file, no problem set, wrong arrays, further arrays that name obstacles,
            or another robot's problems.
    """
    path = Path(path)
    if path.is_dir():
        return _load_shards(path, robot, read_manifest(path)["shards"])
    return load_file(path, robot)


class StoredProblems:
    """A problem set as it is on disk: of a folder, only those shards are read that are asked for.

    Args:
        path: an `.npz`, or a folder of shards.
        robot: the arm that the problems must be for.
    """

    def __init__(self, path: Path, robot: Robot):
        self._folder, self._robot = path, robot
        self._whole = None if path.is_dir() else load_file(path, robot)
        self._shards = read_manifest(path)["shards"] if self._whole is None else []
        counts = [shard["problems"] for shard in self._shards]
        self._firsts = np.cumsum([0, *counts]).tolist()

    def __len__(self) -> int:
        return self._firsts[-1] if self._whole is None else len(self._whole)

    def sha256(self) -> str:
        """Checksum of the file, or of those of all shards; sets of another content have another."""
        if self._whole is not None:
            return _sha256(self._folder)
        sums = "".join(shard["sha256"] for shard in self._shards)
        return hashlib.sha256(sums.encode()).hexdigest()

    def part(self, first: int, last: int) -> ProblemSet:
        """Problems `first` to `last`, the latter not included."""
        if self._whole is not None:
            return self._whole.take(slice(first, last))
        begin = bisect.bisect_right(self._firsts, first) - 1
        end = bisect.bisect_left(self._firsts, last)
        found = _load_shards(self._folder, self._robot, self._shards[begin:end])
        return found.take(slice(first - self._firsts[begin], last - self._firsts[begin]))


def shard_name(index: int) -> str:
    """File of a shard, counted from 0."""
    return f"shard_{index:05d}.npz"


def manifest_of(process: int) -> str:
    """Manifest of the shards that one of several processes has made, until all are there."""
    return f"shard_manifest_{process:05d}.json"


def save_shard(
    folder: str | Path,
    index: int,
    problem_set: ProblemSet,
    *,
    seed: int,
    settings: dict[str, Any],
    manifest_name: str = MANIFEST,
) -> None:
    """Writes shard `index` of a larger set, then enters it in a manifest of the folder.

    A run that was cut short goes on where the manifest ends. One writer of a manifest at a time.

    Args:
        folder: made if missing.
        index: counts from 0; writing a shard again replaces it.
        problem_set: the problems of this shard.
        seed: of the whole set.
        settings: of the generator, as JSON.
        manifest_name: that of the folder, or of one of several processes.

    Raises:
        InputError: the folder holds a set of another robot, seed, settings or code version.
    """
    folder, file = Path(folder), shard_name(index)
    ours = origin(problem_set.robot, seed, settings)
    shards: list[dict[str, Any]] = []
    if (folder / manifest_name).exists():
        manifest = read_manifest(folder, manifest_name)
        check_origin(folder, manifest, ours)
        shards = [shard for shard in manifest["shards"] if shard["file"] != file]
    save_problems(folder / file, problem_set)
    shards.append({"file": file, "problems": len(problem_set), "sha256": _sha256(folder / file)})
    _write_manifest(folder / manifest_name, ours, shards)


def _write_manifest(path: Path, ours: dict[str, Any], shards: list[dict[str, Any]]) -> None:
    shards.sort(key=lambda shard: shard["file"])
    text = json.dumps({**ours, "shards": shards}, indent=1) + "\n"
    atomic_write(path, lambda out: out.write_text(text, encoding="utf-8"))


def known_shards(folder: Path, ours: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """What the manifests of a folder say of each file, whichever process has made it; often once.

    Raises:
        InputError: they are of another set.
    """
    known: dict[str, list[dict[str, Any]]] = {}
    for path in _manifests(folder):
        manifest = read_manifest(folder, path.name)
        check_origin(folder, manifest, ours)
        for shard in manifest["shards"]:
            known.setdefault(shard["file"], []).append(shard)
    return known


def join_manifests(folder: Path, ours: dict[str, Any]) -> None:
    """Makes one manifest of those that several processes have left."""
    parts = [path for path in _manifests(folder) if path.name != MANIFEST]
    if not parts:
        return
    shards = []
    for entries in known_shards(folder, ours).values():
        # Made twice, on machines that round otherwise, a file is as one of them has left it.
        differ = len({shard["sha256"] for shard in entries}) > 1
        shards.append(next((s for s in entries if differ and is_intact(folder, s)), entries[0]))
    _write_manifest(folder / MANIFEST, ours, shards)
    for path in parts:
        path.unlink()


def _manifests(folder: Path) -> list[Path]:
    return [*folder.glob(MANIFEST), *sorted(folder.glob("shard_manifest_*.json"))]


def origin(robot: str, seed: int, settings: dict[str, Any]) -> dict[str, Any]:
    """What all shards of a set have in common, as its manifest says it."""
    return {
        "robot": robot,
        "seed": int(seed),
        "settings": as_json(settings),
        "code_version": code_version(),
    }


def check_origin(folder: str | Path, manifest: dict[str, Any], ours: dict[str, Any]) -> None:
    """Refuses to go on with a set that was generated otherwise.

    Raises:
        InputError: another robot, seed, settings or code version.
    """
    for name, value in ours.items():
        theirs = manifest.get(name)
        if theirs != value:
            if isinstance(theirs, dict) and isinstance(value, dict):
                options = sorted(theirs.keys() | value.keys())
                differ = [x for x in options if theirs.get(x) != value.get(x)]
                name = f"{name} {brief(differ)}"
                theirs, value = ([x.get(option) for option in differ] for x in (theirs, value))
            raise InputError(
                f"{str(folder)!r} was generated with {name} {brief(theirs)}, not {brief(value)}; "
                "write to an empty folder"
            )


def read_manifest(folder: str | Path, name: str = MANIFEST) -> dict[str, Any]:
    """Reads and checks a manifest: robot, seed, settings, code_version and the list of shards."""
    path = Path(folder) / name
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"folder {str(folder)!r} has no {name}; name an .npz, or a folder of shards"
        ) from None
    except IsADirectoryError:
        raise InputError(f"{str(path)!r} is a folder; generate the set again") from None
    except (ValueError, RecursionError) as error:  # no JSON, no text, or nested without end
        raise InputError(f"{str(path)!r} is no JSON: {error}; generate the set again") from None
    shards = manifest.get("shards") if isinstance(manifest, dict) else None
    well_formed = isinstance(shards, list) and all(
        isinstance(shard, dict)
        and type(shard.get("problems")) is int
        and isinstance(shard.get("sha256"), str)
        and isinstance(shard.get("file"), str)
        and _is_file_name(shard["file"])
        for shard in shards
    )
    if not well_formed or not shards:
        raise InputError(
            f'{str(path)!r} lacks a list "shards" of {{"file", "problems", "sha256"}}; '
            "generate the set again"
        )
    return manifest


def is_intact(folder: Path, shard: dict[str, Any]) -> bool:
    """Whether a shard is there as a manifest says."""
    file = folder / shard["file"]
    return file.is_file() and _sha256(file) == shard["sha256"]


def _is_file_name(name: str) -> bool:
    """Whether a file inside of a folder can have this name."""
    try:
        return name == Path(name).name and len(os.fsencode(name)) <= 255 and "\0" not in name
    except UnicodeEncodeError:
        return False


def _load_shards(folder: Path, robot: Robot, shards: list[dict[str, Any]]) -> ProblemSet:
    sets: list[ProblemSet] = []
    for shard in shards:
        file = folder / shard["file"]
        if not file.is_file():
            raise InputError(f"{MANIFEST} names {str(file)!r}, which is missing; generate it again")
        if _sha256(file) != shard["sha256"]:
            raise InputError(
                f"{str(file)!r} is not the file that {MANIFEST} names (its SHA-256 differs); "
                "generate it again"
            )
        sets.append(load_file(file, robot))
        if sets[-1].extras.keys() != sets[0].extras.keys():
            raise InputError(
                f"{str(file)!r} has the further arrays {sorted(sets[-1].extras)}, the first shard "
                f"{sorted(sets[0].extras)}; generate the set again"
            )
    size = max(s.problems.scene.mask.shape[1] for s in sets)
    scenes = same_clouds([pad_scene(s.problems.scene, size) for s in sets])
    problems = [s.problems._replace(scene=x) for s, x in zip(sets, scenes, strict=True)]
    extras = {
        name: np.concatenate([s.extras[name] for s in sets])
        if all(s.extras[name].shape[:1] == (len(s),) for s in sets)
        else value  # one for the whole set
        for name, value in sets[0].extras.items()
    }
    return ProblemSet(robot.name, jax.tree.map(lambda *x: np.concatenate(x), *problems), extras)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
