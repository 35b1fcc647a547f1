"""Problem files: a set of problems as one `.npz` without pickles."""

import logging
from pathlib import Path

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, as_typed, brief
from gnnjax.files import FileKind, atomic_write, read_arrays
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.allowed import refuse_allowed
from gnnjax.scene.batches import same_clouds
from gnnjax.scene.cloud import MOST_METERS, Balls, make_cloud
from gnnjax.scene.numbers import unit_quats
from gnnjax.scene.scene import Scene, box_bucket, pad_scene
from gnnjax.scene.shapes import (
    FIELDS,
    KINDS,
    PLURALS,
    SIZES,
    Sums,
    described,
    for_every_kind,
    kind_of,
    sums_of,
)

_LOG = logging.getLogger(__name__)
_PROBLEMS = FileKind("problem file", "a problem set", "generate it again")
_NAMES = ("robot", "start", "goal")
# From this format on the robot's name tells joints and contacts that were chosen, too.
_FORMAT = "format", 2
# Arrays of a problem file for the obstacles of each kind, by what they hold; and their number.
_ROUND = ("centers", "radii", "half_lengths", "quats")
_ARRAYS = for_every_kind(
    "problem file",
    box=("centers", "half_extents", "quats"),
    sphere=("centers", "radii"),
    capsule=_ROUND,
    cylinder=_ROUND,
    half_space=("points", "normals"),
)
_CLOUD = ("cloud_points", "cloud_radii", "num_cloud_points")  # [P K 3] m, [P] m, [P]
_NUMBERS = {kind: f"num_{PLURALS[kind]}" for kind in KINDS}


def _arrays_of(kind: str) -> dict[str, str]:
    """The arrays of a kind, by what `FIELDS` calls a single entry."""
    return {
        name: f"{kind}_{plural}" for name, plural in zip(FIELDS[kind], _ARRAYS[kind], strict=True)
    }


_NEEDED = (*_NAMES, *_arrays_of("box").values(), _NUMBERS["box"])  # of every file


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


def save_problems(path: str | Path, problem_set: ProblemSet) -> None:
    """Writes a problem set as one `.npz` without pickles; replaces the file atomically.

    Raises:
        InputError: what is no problem set; an extra that only a pickle could hold, or one that
            names obstacles; a scene in which contacts are meant.
    """
    problem_set.check()
    for name, value in problem_set.extras.items():
        if np.asarray(value).dtype.hasobject:
            raise InputError(
                f"extra {name!r} holds Python objects; problem files hold numbers and strings alone"
            )
    _check_further(f"problem file {str(path)!r}", problem_set.extras)
    refuse_allowed(problem_set.problems.scene, "a problem file")
    start, goal, scene = problem_set.problems
    scene = jax.tree.map(np.asarray, scene)
    arrays = {
        _FORMAT[0]: np.array(_FORMAT[1]),
        "robot": np.array(problem_set.robot),
        "start": np.asarray(start, np.float32),
        "goal": np.asarray(goal, np.float32),
    }
    kinds = np.where(scene.mask, kind_of(scene.half_extents, scene.radii), -2)
    if (kinds == -1).any():
        problem, which = np.argwhere(kinds == -1)[0]
        raise InputError(
            f"obstacle {which} of problem {problem} is of no kind of {list(KINDS)}; make scenes "
            "with make_scene or scene_from_shapes"
        )
    for number, kind in enumerate(KINDS):
        chosen = kinds == number
        if not chosen.any() and kind != "box":
            continue
        # First those of the kind, as the file has a number instead of a mask.
        order = np.argsort(~chosen, axis=1, kind="stable")
        most = chosen.shape[1] if kind == "box" else chosen.sum(axis=1).max()
        sums = Sums._make(
            np.take_along_axis(x, order[..., None], axis=1)[:, :most] for x in scene[:4]
        )
        for name, values in described(kind, sums).items():
            flat = values[..., 0] if FIELDS[kind][name] == 1 else values
            arrays[_arrays_of(kind)[name]] = flat.astype(np.float32)
        arrays[_NUMBERS[kind]] = chosen.sum(axis=1).astype(np.int32)
    if scene.cloud is not None:
        # Their grids are made again when they are read.
        held = scene.cloud.points, scene.cloud.radius, scene.cloud.num
        arrays |= dict(zip(_CLOUD, held, strict=True))

    def write(file: Path) -> None:
        with open(file, "wb") as stream:
            np.savez_compressed(stream, **{**problem_set.extras, **arrays})

    atomic_write(path, write)


def load_file(path: Path, robot: Robot) -> ProblemSet:
    arrays = read_arrays(path, _PROBLEMS)
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise InputError(f"problem file {str(path)!r} lacks {missing}; it needs {list(_NEEDED)}")
    named = str(arrays["robot"])
    tells = np.array_equal(arrays.get(_FORMAT[0], 0), _FORMAT[1])
    if named != robot.name and (tells or named != robot.plain_name):
        chosen = named.partition("_chosen_")[0] == robot.name.partition("_chosen_")[0]
        how = " with its --joints, --hold and --allow" if chosen else ""
        raise InputError(
            f"problem file {str(path)!r} is for robot {named!r}, not {robot.name!r}; "
            f"name that robot{how}, or use problems of {robot.name}"
        )
    if named != robot.name:
        _LOG.warning("%r does not tell where joints were held; taken for %s", str(path), robot.name)
    present = [kind for kind in KINDS if _names_of(kind) & arrays.keys()]
    known = {
        *_NAMES,
        *_FORMAT[: int(tells)],
        *_CLOUD,
        *(name for kind in present for name in _names_of(kind)),
    }
    extras = {name: value for name, value in arrays.items() if name not in known}
    _check_further(f"problem file {str(path)!r}", extras)
    num = len(np.atleast_1d(arrays["start"]))
    for name in ("start", "goal"):
        _check_array(path, name, arrays[name], (num, robot.num_dof))
    if num == 0:
        raise InputError(f"problem file {str(path)!r} holds no problems; generate it again")
    start, goal = (_finite(path, name, arrays[name], True) for name in ("start", "goal"))
    parts = [_obstacles(path, kind, arrays, num) for kind in present]
    joined = [np.concatenate(x, axis=1) for x in zip(*parts, strict=True)]
    mask = joined[-1] > 0
    # Existing ones first, of all kinds.
    order = np.argsort(~mask, axis=1, kind="stable")
    most = int(mask.sum(axis=1).max())
    parts = [np.take_along_axis(x, order[..., None], axis=1)[:, :most] for x in joined[:4]]
    scene = Scene._make([*parts, np.take_along_axis(mask, order, axis=1)[:, :most], None, None])
    scene = pad_scene(scene, box_bucket(most, f"problem file {str(path)!r}"))
    if arrays.keys() & set(_CLOUD):
        scene = _with_clouds(path, arrays, scene)
    return ProblemSet(robot.name, Problem(start, goal, scene), extras)


def _names_of(kind: str) -> set[str]:
    return {*_arrays_of(kind).values(), _NUMBERS[kind]}


def _obstacles(path: Path, kind: str, arrays: dict[str, np.ndarray], num: int) -> list[np.ndarray]:
    """Of `num` problems the obstacles of a kind as sums, float32, and which of them exist."""
    missing = sorted(_names_of(kind) - arrays.keys())
    if missing:
        raise InputError(
            f"problem file {str(path)!r} lacks {missing}; its {PLURALS[kind]} need "
            f"{sorted(_names_of(kind))}"
        )
    first = arrays[next(iter(_arrays_of(kind).values()))]
    most = first.shape[1] if first.ndim > 1 else 0
    counts = arrays[_NUMBERS[kind]]
    _check_array(path, _NUMBERS[kind], counts, (num,), "iu")
    if num and not (counts.min() >= 0 and counts.max() <= most):
        raise InputError(
            f"{_NUMBERS[kind]} of problem file {str(path)!r} goes from {counts.min()} to "
            f"{counts.max()}; the file has room for 0 to {most} {PLURALS[kind]}"
        )
    mask = np.arange(most) < counts[:, None]
    values = {}
    for name, width in FIELDS[kind].items():
        called = _arrays_of(kind)[name]
        _check_array(path, called, arrays[called], (num, most, width)[: 2 + (width > 1)])
        array = arrays[called].reshape(num, most, width)
        array = _finite(path, called, array, mask, kind)
        if name in ("quat", "normal"):
            rule = "must be a rotation w x y z" if name == "quat" else "must be a direction"
            zeros = np.abs(array).max(axis=-1, keepdims=True, initial=0.0) < 1e-3
            _refuse(path, called, array, zeros, mask, rule, kind)
        else:
            rule = f"must be below {MOST_METERS:g} m"
            _refuse(path, called, array, np.abs(array) > MOST_METERS, mask, rule, kind)
        if name in SIZES:
            _refuse(path, called, array, ~(array > 0), mask, "must be positive", kind)
        # What lies on padding is replaced, so that no kernel meets NaN or an obstacle without size.
        blank = np.eye(4)[0] if name == "quat" else np.eye(3)[2] if name == "normal" else 0.1
        array = np.where(mask[..., None], array, blank)
        values[name] = unit_quats(array) if name in ("quat", "normal") else array
    return [*(x.astype(np.float32) for x in sums_of(kind, values)), mask]


def _with_clouds(path: Path, arrays: dict[str, np.ndarray], scene: Scene) -> Scene:
    """Scenes `[P, M, ...]` with the clouds of a file."""
    if missing := sorted(set(_CLOUD) - arrays.keys()):
        raise InputError(f"problem file {str(path)!r} lacks {missing}; its clouds need {_CLOUD}")
    points, radii, counts = (arrays[name] for name in _CLOUD)
    num, most = len(scene.mask), points.shape[1] if points.ndim == 3 else 0
    _check_array(path, _CLOUD[0], points, (num, most, 3))
    _check_array(path, _CLOUD[1], radii, (num,))
    _check_array(path, _CLOUD[2], counts, (num,), "iu")
    if not (counts.min() >= 0 and counts.max() <= most):
        raise InputError(
            f"{_CLOUD[2]} of problem file {str(path)!r} goes from {counts.min()} to "
            f"{counts.max()}; the file has room for 0 to {most} points"
        )
    exists = np.arange(most) < counts[:, None]
    points = _finite(path, _CLOUD[0], points, exists, "point")
    too_far = f"must be below {MOST_METERS:g} m"
    _refuse(path, _CLOUD[0], points, np.abs(points) > MOST_METERS, exists, too_far, "point")
    sizes = _finite(path, _CLOUD[1], radii[:, None], counts > 0)
    _refuse(path, _CLOUD[1], sizes, ~(sizes > 0), counts > 0, "must be positive", "")
    # One after the other: each has a grid of its own.
    single = []
    for i, count in enumerate(counts.tolist()):
        balls = [Balls(points[i, :count], float(sizes[i, 0]))] if count else []
        cloud = make_cloud(balls, f"problem {i} of {str(path)!r}") if balls else None
        single.append(jax.tree.map(lambda x, i=i: x[i], scene)._replace(cloud=cloud))
    return jax.tree.map(lambda *x: np.stack(x), *same_clouds(single))


def _check_further(source: str, extras: dict[str, np.ndarray]) -> None:
    """Refuses further arrays whose names are of obstacles."""
    for name in extras:
        words = name.lower().split("_")
        singular = {w.removesuffix(end) for w in words for end in ("", "s", "es")}
        if name.startswith(_OWN_PREFIXES):
            continue
        if singular & _SHAPE_WORDS or name.lower().endswith(_SHAPE_ENDINGS):
            raise InputError(
                f"{source} has the array {name!r}, which names obstacles of no known kind; take "
                "others, or rename it if it holds none"
            )


def _check_array(
    path: Path, name: str, array: np.ndarray, shape: tuple[int, ...], kinds: str = "iuf"
) -> None:
    if array.shape != shape:
        raise InputError(
            f"{name} of problem file {str(path)!r} has shape {array.shape}, not {shape}; "
            "generate it again"
        )
    if array.dtype.kind not in kinds:
        wanted = "integers" if kinds == "iu" else "real numbers"
        raise InputError(
            f"{name} of problem file {str(path)!r} holds {array.dtype}, not {wanted}; "
            "generate it again"
        )


def _finite(
    path: Path, name: str, array: np.ndarray, rows: np.ndarray | bool, kind: str = ""
) -> np.ndarray:
    with np.errstate(over="ignore"):  # too large for float32 is infinite, and refused as such
        array = array.astype(np.float32)
    _refuse(path, name, array, ~np.isfinite(array), rows, "must be finite", kind)
    return array


def _refuse(
    path: Path,
    name: str,
    array: np.ndarray,
    bad: np.ndarray,
    rows: np.ndarray | bool,
    rule: str,
    kind: str,
) -> None:
    """Raises for the first of `rows` that holds something bad."""
    where = np.argwhere(bad.any(axis=-1) & rows)
    if len(where):
        which = f" ({kind} {where[0][1]})" if len(where[0]) > 1 else ""
        raise InputError(
            f"{name} of problem {where[0][0]}{which} in {str(path)!r} is "
            f"{brief(as_typed(array[tuple(where[0])]))}; it {rule}"
        )
