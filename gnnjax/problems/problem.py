"""Planning problems, and sets of them on disk: one `.npz`, or a folder of such shards."""

import dataclasses
import hashlib
import importlib.metadata
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief
from gnnjax.files import atomic_write, read_arrays
from gnnjax.roadmap.sampled import sample_free
from gnnjax.scene.scene import MOST_METERS, Scene, box_bucket, pad_scene, sample_scene, unit_quats
from gnnjax.scene.shapes import for_every_kind

MANIFEST = "manifest.json"  # of a folder of shards

# Arrays of a problem file for the obstacles of each kind.
_ARRAYS = for_every_kind(
    "problem file", box=("box_centers", "box_half_extents", "box_quats", "num_boxes")
)
_NAMES = ("robot", "start", "goal", *_ARRAYS["box"])

# Further arrays are kept, but for those whose names are of obstacles: left out, they would be
# planned through. Words of a name in the singular; and how the arrays of a kind of shape end.
_SHAPE_WORDS = frozenset(
    "box sphere capsule cylinder ellipsoid cone torus prism pyramid plane halfspace floor wall "
    "mesh hull vertex vertice face triangle heightfield hfield cloud voxel octomap occupancy sdf "
    "obstacle primitive shape".split()
)
_SHAPE_ENDINGS = tuple(
    "_centers _quats _radii _half_lengths _half_extents _heights _points _normals _offsets "
    "_poses".split()
)
_OWN_PREFIXES = ("roadmap_", "label_")  # of what is generated for training


class Problem(NamedTuple):
    """A query: get from start to goal through a scene."""

    start: Float[Array, "*batch D"]  # rad or m
    goal: Float[Array, "*batch D"]
    scene: Scene


@dataclasses.dataclass(frozen=True)
class ProblemSet:
    """P problems for one robot; the arrays are NumPy with a leading axis P."""

    robot: str
    problems: Problem
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)  # kept as they are

    def __len__(self) -> int:
        return len(self.problems.start)

    def take(self, rows: slice | np.ndarray) -> "ProblemSet":
        """Some of the problems; extras that have one row a problem are cut likewise."""
        cut = {
            name: value[rows] if value.shape[:1] == (len(self),) else value
            for name, value in self.extras.items()
        }
        return ProblemSet(self.robot, jax.tree.map(lambda x: x[rows], self.problems), cut)


def sample_problem(
    key: jax.Array,
    robot: Robot,
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    boxes_clear: Callable[[Scene], Bool[Array, " M"]],
) -> Problem:
    """Draws a problem of the paper: a random scene, start and goal uniform in its free space.

    Where 800 draws find no free configuration, an end is q = 0, which the scene leaves clear.

    Args:
        key: randomness.
        robot: the arm.
        check_configurations: of a `Checker`.
        boxes_clear: tells for each box whether the arm at q = 0 is clear of it.
    """
    scene_key, ends_key = jax.random.split(key)
    scene = sample_scene(scene_key, boxes_clear)

    def check(q: jax.Array) -> jax.Array:
        return check_configurations(scene, q)

    # Sixteen draws a block, of which the first two that are free count.
    ends = sample_free(ends_key, check, robot.joint_lower, robot.joint_upper, 16, wanted=2)
    return Problem(ends.nodes[0], ends.nodes[1], scene)


def save_problems(path: str | Path, problem_set: ProblemSet) -> None:
    """Writes a problem set as one `.npz` without pickles; replaces the file atomically.

    Raises:
        InputError: an extra that only a pickle could hold, or one that names obstacles.
    """
    for name, value in problem_set.extras.items():
        if np.asarray(value).dtype.hasobject:
            raise InputError(
                f"extra {name!r} holds Python objects; problem files hold numbers and strings alone"
            )
    _check_further(f"problem file {str(path)!r}", problem_set.extras)
    start, goal, scene = jax.tree.map(np.asarray, problem_set.problems)
    # Existing boxes first, as the file has a number instead of a mask.
    order = np.argsort(~scene.mask, axis=1, kind="stable")
    arrays = {
        "robot": np.array(problem_set.robot),
        "start": start.astype(np.float32),
        "goal": goal.astype(np.float32),
        "box_centers": np.take_along_axis(scene.centers, order[..., None], axis=1),
        "box_half_extents": np.take_along_axis(scene.half_extents, order[..., None], axis=1),
        "box_quats": np.take_along_axis(scene.quats, order[..., None], axis=1),
        "num_boxes": scene.mask.sum(axis=1).astype(np.int32),
    }

    def write(file: Path) -> None:
        with open(file, "wb") as stream:
            np.savez_compressed(stream, **{**problem_set.extras, **arrays})

    atomic_write(path, write)


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
    return _load_shards(path, robot) if path.is_dir() else _load_file(path, robot)


def save_shard(
    folder: str | Path, index: int, problem_set: ProblemSet, *, seed: int, settings: dict[str, Any]
) -> None:
    """Writes shard `index` of a larger set, then enters it in the folder's manifest.

    A run that was cut short goes on where the manifest ends. One writer at a time.

    Args:
        folder: made if missing.
        index: counts from 0; writing a shard again replaces it.
        problem_set: the problems of this shard.
        seed: of the whole set.
        settings: of the generator, as JSON.

    Raises:
        InputError: the folder holds a set of another robot, seed, settings or code version.
    """
    folder, file = Path(folder), f"shard_{index:05d}.npz"
    ours = origin(problem_set.robot, seed, settings)
    shards: list[dict[str, Any]] = []
    if (folder / MANIFEST).exists():
        manifest = read_manifest(folder)
        check_origin(folder, manifest, ours)
        shards = [shard for shard in manifest["shards"] if shard["file"] != file]
    save_problems(folder / file, problem_set)
    shards.append({"file": file, "problems": len(problem_set), "sha256": _sha256(folder / file)})
    shards.sort(key=lambda shard: shard["file"])
    text = json.dumps({**ours, "shards": shards}, indent=1) + "\n"
    atomic_write(folder / MANIFEST, lambda out: out.write_text(text, encoding="utf-8"))


def origin(robot: str, seed: int, settings: dict[str, Any]) -> dict[str, Any]:
    """What all shards of a set have in common, as its manifest says it."""
    return {
        "robot": robot,
        "seed": seed,
        # As it will be read back: tuples become lists.
        "settings": json.loads(json.dumps(settings)),
        "code_version": _code_version(),
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


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """Reads and checks a manifest: robot, seed, settings, code_version and the list of shards."""
    path = Path(folder) / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"folder {str(folder)!r} has no {MANIFEST}; name an .npz, or a folder of shards"
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


def intact_shards(folder: str | Path) -> dict[str, int]:
    """The shards that a manifest names and that are there as it says, and their problems."""
    folder = Path(folder)
    return {
        shard["file"]: shard["problems"]
        for shard in read_manifest(folder)["shards"]
        if (folder / shard["file"]).is_file() and _sha256(folder / shard["file"]) == shard["sha256"]
    }


def _is_file_name(name: str) -> bool:
    """Whether a file inside of a folder can have this name."""
    try:
        return name == Path(name).name and len(os.fsencode(name)) <= 255 and "\0" not in name
    except UnicodeEncodeError:
        return False


def _load_shards(folder: Path, robot: Robot) -> ProblemSet:
    sets: list[ProblemSet] = []
    for shard in read_manifest(folder)["shards"]:
        file = folder / shard["file"]
        if not file.is_file():
            raise InputError(f"{MANIFEST} names {str(file)!r}, which is missing; generate it again")
        if _sha256(file) != shard["sha256"]:
            raise InputError(
                f"{str(file)!r} is not the file that {MANIFEST} names (its SHA-256 differs); "
                "generate it again"
            )
        sets.append(_load_file(file, robot))
        if sets[-1].extras.keys() != sets[0].extras.keys():
            raise InputError(
                f"{str(file)!r} has the further arrays {sorted(sets[-1].extras)}, the first shard "
                f"{sorted(sets[0].extras)}; generate the set again"
            )
    size = max(s.problems.scene.mask.shape[1] for s in sets)
    problems = [s.problems._replace(scene=pad_scene(s.problems.scene, size)) for s in sets]
    extras = {
        name: np.concatenate([s.extras[name] for s in sets])
        if all(s.extras[name].shape[:1] == (len(s),) for s in sets)
        else value  # one for the whole set
        for name, value in sets[0].extras.items()
    }
    return ProblemSet(robot.name, jax.tree.map(lambda *x: np.concatenate(x), *problems), extras)


def _load_file(path: Path, robot: Robot) -> ProblemSet:
    arrays = read_arrays(path)
    missing = [name for name in _NAMES if name not in arrays]
    if missing:
        raise InputError(f"problem file {str(path)!r} lacks {missing}; it needs {list(_NAMES)}")
    named = str(arrays["robot"])
    if named != robot.name:
        raise InputError(
            f"problem file {str(path)!r} is for robot {named!r}, not {robot.name!r}; "
            f"name that robot, or use problems of {robot.name}"
        )
    extras = {name: value for name, value in arrays.items() if name not in _NAMES}
    _check_further(f"problem file {str(path)!r}", extras)
    _check_shapes(path, arrays, robot.num_dof)
    mask = np.arange(arrays["box_centers"].shape[1]) < arrays["num_boxes"][:, None]
    start, goal, centers, half_extents, quats = (
        _finite(path, name, arrays[name], rows)
        for name, rows in zip(_NAMES[1:6], (True, True, mask, mask, mask), strict=True)
    )
    _refuse(path, "box_half_extents", half_extents, ~(half_extents > 0), mask, "must be positive")
    for name, lengths in (("box_centers", centers), ("box_half_extents", half_extents)):
        rule = f"must be below {MOST_METERS:g} m"
        _refuse(path, name, lengths, np.abs(lengths) > MOST_METERS, mask, rule)
    zeros = np.abs(quats).max(axis=-1, keepdims=True, initial=0.0) < 1e-3
    _refuse(path, "box_quats", quats, zeros, mask, "must be a rotation w x y z")
    # What lies on padding is replaced, so that no kernel meets NaN or a box without size there.
    exists = mask[..., None]
    scene = Scene(
        np.where(exists, centers, np.float32(0)),
        np.where(exists, half_extents, np.float32(0.1)),
        np.where(exists, unit_quats(np.where(exists, quats, 1)), [1, 0, 0, 0]).astype(np.float32),
        mask,
    )
    most = int(arrays["num_boxes"].max(initial=0))
    scene = pad_scene(jax.tree.map(lambda x: x[:, :most], scene), box_bucket(most))
    return ProblemSet(robot.name, Problem(start, goal, scene), extras)


def _check_further(source: str, extras: dict[str, np.ndarray]) -> None:
    """Refuses further arrays whose names are of obstacles."""
    for name in extras:
        words = name.lower().split("_")
        singular = {w.removesuffix(end) for w in words for end in ("", "s", "es")}
        if name.startswith(_OWN_PREFIXES):
            continue
        if singular & _SHAPE_WORDS or name.lower().endswith(_SHAPE_ENDINGS):
            raise InputError(
                f"{source} has the array {name!r}, which names obstacles, and only boxes are "
                "known; enclose them in boxes, or rename the array if it holds none"
            )


def _check_shapes(path: Path, arrays: dict[str, np.ndarray], num_dof: int) -> None:
    num = len(np.atleast_1d(arrays["start"]))
    most = arrays["box_centers"].shape[1] if arrays["box_centers"].ndim == 3 else 0
    expected = {
        "start": (num, num_dof),
        "goal": (num, num_dof),
        "box_centers": (num, most, 3),
        "box_half_extents": (num, most, 3),
        "box_quats": (num, most, 4),
        "num_boxes": (num,),
    }
    for name, shape in expected.items():
        array = arrays[name]
        if array.shape != shape:
            raise InputError(
                f"{name} of problem file {str(path)!r} has shape {array.shape}, not {shape}; "
                "generate it again"
            )
        kinds = "iu" if name == "num_boxes" else "iuf"
        if array.dtype.kind not in kinds:
            wanted = "integers" if name == "num_boxes" else "real numbers"
            raise InputError(
                f"{name} of problem file {str(path)!r} holds {array.dtype}, not {wanted}; "
                "generate it again"
            )
    if num == 0:
        raise InputError(f"problem file {str(path)!r} holds no problems; generate it again")
    counts = arrays["num_boxes"]
    if not (counts.min() >= 0 and counts.max() <= most):
        raise InputError(
            f"num_boxes of problem file {str(path)!r} goes from {counts.min()} to {counts.max()}; "
            f"the file has room for 0 to {most} boxes"
        )


def _finite(path: Path, name: str, array: np.ndarray, rows: np.ndarray | bool) -> np.ndarray:
    with np.errstate(over="ignore"):  # too large for float32 is infinite, and refused as such
        array = array.astype(np.float32)
    _refuse(path, name, array, ~np.isfinite(array), rows, "must be finite")
    return array


def _refuse(
    path: Path, name: str, array: np.ndarray, bad: np.ndarray, rows: np.ndarray | bool, rule: str
) -> None:
    """Raises for the first of `rows` that holds something bad."""
    where = np.argwhere(bad.any(axis=-1) & rows)
    if len(where):
        box = f" (box {where[0][1]})" if len(where[0]) > 1 else ""
        raise InputError(
            f"{name} of problem {where[0][0]}{box} in {str(path)!r} is "
            f"{brief(array[tuple(where[0])].tolist())}; it {rule}"
        )


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _code_version() -> str:
    try:
        return importlib.metadata.version("gnnjax")
    except importlib.metadata.PackageNotFoundError:  # run from a checkout that is not installed
        return "unknown"
