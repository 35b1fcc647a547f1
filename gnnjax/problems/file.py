"""Problem files: a set of problems as one `.npz` without pickles."""

from pathlib import Path

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief
from gnnjax.files import atomic_write, read_arrays
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.scene import MOST_METERS, Scene, box_bucket, pad_scene, unit_quats
from gnnjax.scene.shapes import for_every_kind

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


def load_file(path: Path, robot: Robot) -> ProblemSet:
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
