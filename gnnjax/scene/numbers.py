"""Numbers of obstacles as people and files give them, checked and brought into one form."""

import contextlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from gnnjax.arm.parts import quat_to_matrix
from gnnjax.errors import InputError, as_floats, as_typed, brief, is_list
from gnnjax.scene.cloud import MOST_METERS
from gnnjax.scene.shapes import (
    FIELDS,
    HALF_SPACE,
    IDENTITY_QUAT,
    KINDS,
    PLURALS,
    SIZES,
    Shape,
    Sums,
    sums_of,
)


def check_shapes(shapes: Sequence, called: str) -> None:
    """Refuses what is no list of shapes, and shapes of no kind: nobody would read them."""
    if isinstance(shapes, Shape) or not (
        is_list(shapes) and all(isinstance(x, Shape) for x in shapes)
    ):
        raise InputError(
            f"{called} is {brief(shapes)}; give a list of box(...), sphere(...), ..., and what "
            "mesh(...) and the like make as clouds of a scene"
        )
    if unknown := [x.kind for x in shapes if x.kind not in KINDS]:
        raise InputError(f"{called} has a {brief(unknown[0])}; there are only {list(KINDS)}")


def sums_from(kind: str, columns: dict[str, Sequence | np.ndarray], source: str) -> Sums:
    """Checks M obstacles of a kind and brings them into one form.

    Args:
        kind: theirs.
        columns: M values by the names of `FIELDS`; quaternions may be left out.
        source: how error messages call the scene.

    Raises:
        InputError: see `scene_from_shapes`.
    """
    fields = FIELDS[kind]
    values = {
        name: rows(PLURALS[name], columns[name], fields[name], kind, source)
        for name in fields
        if name in columns
    }
    num = len(values[next(iter(fields))])
    if "quat" in fields and "quat" not in values:
        values["quat"] = np.tile(IDENTITY_QUAT, (num, 1))
    if len({len(x) for x in values.values()}) > 1:
        counts = ", ".join(f"{len(x)} {PLURALS[name]}" for name, x in values.items())
        raise InputError(f"{source} has {counts}; give one of each a {kind}")
    for name in (name for name in SIZES if name in values):
        bad = ~(values[name] > 0).all(axis=1)
        if bad.any():
            i = int(bad.argmax())
            raise InputError(
                f"{kind} {i} of {source} has {name} {as_typed(values[name][i])}; "
                "it must be positive (m)"
            )
    for name, remedy in (("quat", "a rotation as w x y z"), ("normal", "a direction")):
        largest = np.abs(values.get(name, np.ones((1, 1)))).max(axis=1, initial=0.0)
        if len(largest) and largest.min() < 1e-3:
            i = int(largest.argmin())
            raise InputError(
                f"{kind} {i} of {source} has the {PLURALS[name][:-1]} {as_typed(values[name][i])}; "
                f"give {remedy}, not zeros"
            )
    for name in ("quat", "normal"):
        if name in values:
            values[name] = unit_quats(values[name])
    if kind == "half_space":
        above = np.sum(values["point"] * values["normal"], axis=1)
        if len(above) and above.max() > HALF_SPACE:
            raise InputError(
                f"half_space {int(above.argmax())} of {source} reaches {above.max():g} m beyond "
                "the base and leaves no arm any room; give a normal that points out of it"
            )
    if kind == "box":  # which of this very size would stand for half-spaces
        huge = (np.float32(values["half_extents"]) == HALF_SPACE).all(axis=1)
        values["half_extents"][huge] = np.nextafter(np.float32(HALF_SPACE), np.float32(np.inf))
    return sums_of(kind, values)


def number_of(value: Any, called: str, unit: str = "") -> float:
    """A number of a JSON file, where booleans and strings would pass for numbers in Python.

    Args:
        value: of the file.
        called: what has it, and its name, in error messages.
        unit: of the number, likewise.

    Raises:
        InputError: no number, or one too large for a computer's.
    """
    with contextlib.suppress(OverflowError):
        if type(value) in (int, float):
            return float(value)
    raise InputError(f"{called} = {brief(value)}; give a number{unit and f' ({unit})'}")


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Normalizes quaternions `[*batch, 4]`, however long they are; those of zeros stay."""
    quats = np.asarray(quats, float)
    # In double precision, and scaled first: the square of 1e20 is infinite in single precision.
    largest = np.abs(quats).max(axis=-1, keepdims=True)
    scaled = quats / np.where(largest > 0, largest, 1)
    norms = np.linalg.norm(scaled, axis=-1, keepdims=True)
    return scaled / np.where(norms > 0, norms, 1)


def rows(
    name: str, values: Sequence | np.ndarray, width: int, kind: str, source: str
) -> np.ndarray:
    """Numbers `[M, width]` of M obstacles, or what is wrong with them."""
    try:
        array = as_floats(values)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} of {source} are not numbers; give {width} a {kind}") from None
    if array.size == 0:
        return np.zeros((0, width))
    if width == 1 and array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != width:
        raise InputError(
            f"{name} of {source} have shape {array.shape}; give {width} numbers a {kind}"
        )
    bad = ~np.isfinite(array).all(axis=1)
    if name not in ("quats", "normals"):  # those are normalized, whatever their length
        bad |= (np.abs(array) > MOST_METERS).any(axis=1)
    if bad.any():
        raise InputError(
            f"{kind} {int(bad.argmax())} of {source} has {name} {as_typed(array[bad.argmax()])}; "
            f"all numbers must be finite, and lengths below {MOST_METERS:g} m"
        )
    return array


def rotation_of(quat: Sequence | np.ndarray, called: str) -> np.ndarray:
    """The rotation `[3, 3]` of a quaternion w x y z of any length, or what is wrong with it."""
    array = vector_of(quat, f"quat of {called}", 4)
    if np.linalg.norm(array) < 1e-3:
        raise InputError(f"quat of {called} is {array.tolist()}; give a rotation as w x y z")
    return quat_to_matrix(unit_quats(array))


def vector_of(value: Sequence | np.ndarray, called: str, width: int = 3) -> np.ndarray:
    """A vector as people give it, or what is wrong with it."""
    try:
        array = as_floats(value)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != (width,) or not np.isfinite(array).all():
        raise InputError(f"{called} is {value!r}; give {width} finite numbers")
    return array
