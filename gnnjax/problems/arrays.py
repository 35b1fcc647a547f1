"""What a problem file's arrays are called, and what they may hold."""

import itertools
import re
from pathlib import Path

import numpy as np

from gnnjax.errors import InputError, as_typed, brief
from gnnjax.scene.shapes import FIELDS, KINDS, PLURALS, for_every_kind

NAMES = ("robot", "start", "goal")
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
CLOUD = ("cloud_points", "cloud_radii", "num_cloud_points")  # [P K 3] m, [P] m, [P]
NUMBERS = {kind: f"num_{PLURALS[kind]}" for kind in KINDS}


def arrays_of(kind: str) -> dict[str, str]:
    """The arrays of a kind, by what `FIELDS` calls a single entry."""
    return {
        name: f"{kind}_{plural}" for name, plural in zip(FIELDS[kind], _ARRAYS[kind], strict=True)
    }


def names_of(kind: str) -> set[str]:
    """All arrays of a kind."""
    return {*arrays_of(kind).values(), NUMBERS[kind]}


NEEDED = (*NAMES, *arrays_of("box").values(), NUMBERS["box"])  # of every file


# Further arrays are kept, but for those whose names are of obstacles: left out, they would be
# planned through. Words of a name in the singular, alone or two as one; and how the arrays of a
# kind of shape end.
_SHAPE_WORDS = frozenset(
    "box cuboid block brick obb aabb sphere ball capsule cylinder pillar ellipsoid cone "
    "torus prism pyramid plane halfspace ground floor wall mesh hull vertex vertice face "
    "triangle heightfield hfield cloud voxel octomap occupancy sdf obstacle primitive "
    "shape".split()
)

_SHAPE_ENDINGS = tuple(
    "_centers _quats _radii _half_lengths _half_extents _heights _points _normals _offsets "
    "_poses".split()
)

_OWN_PREFIXES = ("roadmap_", "label_")  # of what is generated for training


def check_further(source: str, extras: dict[str, np.ndarray]) -> None:
    """Refuses further arrays whose names are of obstacles."""
    for name in extras:
        if name.startswith(_OWN_PREFIXES):
            continue
        words = re.findall("[a-z]+", re.sub("ground.?truth", "", name.lower()))
        words += [first + second for first, second in itertools.pairwise(words)]
        singular = {w.removesuffix(end) for w in words for end in ("", "s", "es")}
        if singular & _SHAPE_WORDS or name.lower().endswith(_SHAPE_ENDINGS):
            raise InputError(
                f"{source} has the array {name!r}, which names obstacles of no known kind; take "
                "others, or rename it if it holds none"
            )


def check_array(
    path: Path, name: str, array: np.ndarray, shape: tuple[int, ...], kinds: str = "iuf"
) -> None:
    """Refuses an array of another shape, or of other numbers than NumPy's `kinds`."""
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


def finite(
    path: Path, name: str, array: np.ndarray, rows: np.ndarray | bool, kind: str = ""
) -> np.ndarray:
    """An array in single precision, of which those of `rows` must be finite."""
    with np.errstate(over="ignore"):  # too large for float32 is infinite, and refused as such
        array = array.astype(np.float32)
    refuse(path, name, array, ~np.isfinite(array), rows, "must be finite", kind)
    return array


def refuse(
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
