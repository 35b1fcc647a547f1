"""Problem files: a set of problems as one `.npz` without pickles."""

import logging
from pathlib import Path

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.array_files import FileKind, read_arrays
from gnnjax.errors import InputError, brief
from gnnjax.files import atomic_write
from gnnjax.problems.arrays import (
    CLOUD,
    NAMES,
    NEEDED,
    NUMBERS,
    arrays_of,
    check_array,
    check_further,
    finite,
    names_of,
    refuse,
)
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.allowed import refuse_allowed
from gnnjax.scene.batches import same_clouds
from gnnjax.scene.cloud import MOST_METERS, Balls, make_cloud
from gnnjax.scene.numbers import unit_quats
from gnnjax.scene.scene import Scene, obstacle_bucket, pad_scene
from gnnjax.scene.shapes import (
    FIELDS,
    KINDS,
    PLURALS,
    SIZES,
    Sums,
    described,
    known_kinds,
    sums_of,
)

_LOG = logging.getLogger(__name__)
_PROBLEMS = FileKind("problem file", "a problem set", "generate it again")
# In this format the robot's name tells joints and contacts that were chosen, too. Files of the one
# before name no format.
_FORMAT = 2
_OWN = (*NAMES, "format")
# By keyword, NumPy takes these for arguments of its own.
_NUMPYS = ("file", "allow_pickle")


def save_problems(path: str | Path, problem_set: ProblemSet) -> None:
    """Writes a problem set as one `.npz` without pickles; replaces the file atomically.

    Raises:
        InputError: what is no problem set; an extra that only a pickle could hold, one that names
            obstacles, or one called like an array of each file; a scene in which contacts are
            meant.
    """
    if not isinstance(problem_set, ProblemSet):
        raise InputError(f"{brief(problem_set)} is no ProblemSet; give what load_problems returns")
    problem_set.check()
    if not len(problem_set):
        raise InputError("the problem set holds no problems; give one or more")
    extras = {}
    for name, value in problem_set.extras.items():
        if not isinstance(name, str) or "\0" in name:
            raise InputError(f"an extra is called {brief(name)}; give it a name of letters")
        try:
            extras[name] = np.asarray(value)
        except ValueError:
            raise InputError(f"extra {name!r} is no array; its rows differ in length") from None
        if name in (*_OWN, *_NUMPYS):
            raise InputError(f"an extra is called {name!r}, a name that is taken; rename it")
        if extras[name].dtype.hasobject:
            raise InputError(
                f"extra {name!r} holds Python objects; problem files hold numbers and strings alone"
            )
    check_further(f"problem file {str(path)!r}", extras)
    refuse_allowed(problem_set.problems.scene, "a problem file")
    start, goal, scene = problem_set.problems
    scene = jax.tree.map(np.asarray, scene)
    arrays = {
        "format": np.array(_FORMAT),
        "robot": np.array(problem_set.robot),
        "start": np.asarray(start, np.float32),
        "goal": np.asarray(goal, np.float32),
    }
    kinds = known_kinds(scene.half_extents, scene.radii, scene.mask)
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
            arrays[arrays_of(kind)[name]] = flat.astype(np.float32)
        arrays[NUMBERS[kind]] = chosen.sum(axis=1).astype(np.int32)
    if scene.cloud is not None:
        # Their grids are made again when they are read.
        held = scene.cloud.points, scene.cloud.radius, scene.cloud.num
        arrays |= dict(zip(CLOUD, held, strict=True))

    def write(file: Path) -> None:
        with open(file, "wb") as stream:
            np.savez_compressed(stream, **{**extras, **arrays})

    atomic_write(path, write)


def load_file(path: Path, robot: Robot) -> ProblemSet:
    arrays = read_arrays(path, _PROBLEMS)
    tells = "format" in arrays
    if tells and not np.array_equal(arrays["format"], _FORMAT):
        raise InputError(
            f"problem file {str(path)!r} has format {brief(arrays['format'].tolist())}, this one "
            f"reads format {_FORMAT}; generate it again, or install the version that wrote it"
        )
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise InputError(f"problem file {str(path)!r} lacks {missing}; it needs {list(NEEDED)}")
    named = str(arrays["robot"])
    if named != robot.name and (tells or named != robot.plain_name):
        chosen = named.partition("_chosen_")[0] == robot.name.partition("_chosen_")[0]
        how = " with its --joints, --hold and --allow" if chosen else ""
        raise InputError(
            f"problem file {str(path)!r} is for robot {named!r}, not {robot.name!r}; "
            f"name that robot{how}, or use problems of {robot.name}"
        )
    if named != robot.name:
        _LOG.warning("%r does not tell where joints were held; taken for %s", str(path), robot.name)
    present = [kind for kind in KINDS if names_of(kind) & arrays.keys()]
    known = {*_OWN, *CLOUD, *(name for kind in present for name in names_of(kind))}
    extras = {name: value for name, value in arrays.items() if name not in known}
    check_further(f"problem file {str(path)!r}", extras)
    num = len(np.atleast_1d(arrays["start"]))
    for name in ("start", "goal"):
        check_array(path, name, arrays[name], (num, robot.num_dof))
    if num == 0:
        raise InputError(f"problem file {str(path)!r} holds no problems; generate it again")
    start, goal = (finite(path, name, arrays[name], True) for name in ("start", "goal"))
    parts = [_obstacles(path, kind, arrays, num) for kind in present]
    joined = [np.concatenate(x, axis=1) for x in zip(*parts, strict=True)]
    mask = joined[-1] > 0
    # Existing ones first, of all kinds.
    order = np.argsort(~mask, axis=1, kind="stable")
    most = int(mask.sum(axis=1).max())
    parts = [np.take_along_axis(x, order[..., None], axis=1)[:, :most] for x in joined[:4]]
    scene = Scene._make([*parts, np.take_along_axis(mask, order, axis=1)[:, :most], None, None])
    scene = pad_scene(scene, obstacle_bucket(most, f"problem file {str(path)!r}"))
    if arrays.keys() & set(CLOUD):
        scene = _with_clouds(path, arrays, scene)
    return ProblemSet(robot.name, Problem(start, goal, scene), extras)


def _obstacles(path: Path, kind: str, arrays: dict[str, np.ndarray], num: int) -> list[np.ndarray]:
    """Of `num` problems the obstacles of a kind as sums, float32, and which of them exist."""
    missing = sorted(names_of(kind) - arrays.keys())
    if missing:
        raise InputError(
            f"problem file {str(path)!r} lacks {missing}; its {PLURALS[kind]} need "
            f"{sorted(names_of(kind))}"
        )
    first = arrays[next(iter(arrays_of(kind).values()))]
    most = first.shape[1] if first.ndim > 1 else 0
    counts = arrays[NUMBERS[kind]]
    check_array(path, NUMBERS[kind], counts, (num,), "iu")
    if num and not (counts.min() >= 0 and counts.max() <= most):
        raise InputError(
            f"{NUMBERS[kind]} of problem file {str(path)!r} goes from {counts.min()} to "
            f"{counts.max()}; the file has room for 0 to {most} {PLURALS[kind]}"
        )
    mask = np.arange(most) < counts[:, None]
    values = {}
    for name, width in FIELDS[kind].items():
        called = arrays_of(kind)[name]
        check_array(path, called, arrays[called], (num, most, width)[: 2 + (width > 1)])
        array = arrays[called].reshape(num, most, width)
        array = finite(path, called, array, mask, kind)
        if name in ("quat", "normal"):
            rule = "must be a rotation w x y z" if name == "quat" else "must be a direction"
            zeros = np.abs(array).max(axis=-1, keepdims=True, initial=0.0) < 1e-3
            refuse(path, called, array, zeros, mask, rule, kind)
        else:
            rule = f"must be below {MOST_METERS:g} m"
            refuse(path, called, array, np.abs(array) > MOST_METERS, mask, rule, kind)
        if name in SIZES:
            refuse(path, called, array, ~(array > 0), mask, "must be positive", kind)
        # What lies on padding is replaced, so that no kernel meets NaN or an obstacle without size.
        blank = np.eye(4)[0] if name == "quat" else np.eye(3)[2] if name == "normal" else 0.1
        array = np.where(mask[..., None], array, blank)
        values[name] = unit_quats(array) if name in ("quat", "normal") else array
    return [*(x.astype(np.float32) for x in sums_of(kind, values)), mask]


def _with_clouds(path: Path, arrays: dict[str, np.ndarray], scene: Scene) -> Scene:
    """Scenes `[P, M, ...]` with the clouds of a file."""
    if missing := sorted(set(CLOUD) - arrays.keys()):
        raise InputError(f"problem file {str(path)!r} lacks {missing}; its clouds need {CLOUD}")
    points, radii, counts = (arrays[name] for name in CLOUD)
    num, most = len(scene.mask), points.shape[1] if points.ndim == 3 else 0
    check_array(path, CLOUD[0], points, (num, most, 3))
    check_array(path, CLOUD[1], radii, (num,))
    check_array(path, CLOUD[2], counts, (num,), "iu")
    if not (counts.min() >= 0 and counts.max() <= most):
        raise InputError(
            f"{CLOUD[2]} of problem file {str(path)!r} goes from {counts.min()} to "
            f"{counts.max()}; the file has room for 0 to {most} points"
        )
    exists = np.arange(most) < counts[:, None]
    points = finite(path, CLOUD[0], points, exists, "point")
    too_far = f"must be below {MOST_METERS:g} m"
    refuse(path, CLOUD[0], points, np.abs(points) > MOST_METERS, exists, too_far, "point")
    sizes = finite(path, CLOUD[1], radii[:, None], counts > 0)
    refuse(path, CLOUD[1], sizes, ~(sizes > 0), counts > 0, "must be positive", "")
    # One after the other: each has a grid of its own.
    single = []
    for i, count in enumerate(counts.tolist()):
        balls = [Balls(points[i, :count], float(sizes[i, 0]))] if count else []
        cloud = make_cloud(balls, f"problem {i} of {str(path)!r}") if balls else None
        single.append(jax.tree.map(lambda x, i=i: x[i], scene)._replace(cloud=cloud))
    return jax.tree.map(lambda *x: np.stack(x), *same_clouds(single))
