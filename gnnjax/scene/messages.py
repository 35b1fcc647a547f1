"""ROS messages written as YAML: read whole, and checked as they are taken apart."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gnnjax.errors import InputError, brief
from gnnjax.scene.numbers import unit_quats
from gnnjax.scene.pose import Pose

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # tenfold faster, where it is built


class _UnrepeatedLoader(_Loader):
    """Of a key that comes twice, YAML's loaders would drop the first value."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if len(set(names)) < len(names):
            raise ValueError(f"{max(names, key=names.count)!r} comes twice in one mapping")
        return super().construct_mapping(node, deep=deep)


def read_message(path: str | Path, what: str, known: Collection[str]) -> dict[str, Any]:
    """Reads the one message of a YAML file.

    Args:
        path: of the file.
        what: it should hold, for error messages.
        known: fields that the message may have.

    Raises:
        InputError: no such file, no YAML, another number of messages than one, other fields.
    """
    called = f"{what} {str(path)!r}"
    try:
        text = Path(path).read_text(encoding="utf-8")
        # `rostopic echo` ends each message with the line that separates documents.
        found = [x for x in yaml.load_all(text, _UnrepeatedLoader) if x is not None]
    except FileNotFoundError:
        raise InputError(f"no {called}; check the path") from None
    except IsADirectoryError:
        raise InputError(f"{called} is a folder; name a file") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{called} is no YAML: {error}; mend it") from None
    if len(found) != 1:
        raise InputError(f"{called} holds {len(found)} messages; give a file with one")
    return fields_of(found[0], known, called)


def fields_of(value: Any, known: Collection[str], called: str) -> dict[str, Any]:
    """A message's fields, of which none may be unknown: what is not read might be an obstacle."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(f"{called} is {brief(value)}; it should have fields such as {min(known)}")
    if unknown := sorted(map(str, value.keys() - set(known))):
        raise InputError(f"{called} has {unknown}, which is not known here; remove what it names")
    return value


def list_of(message: dict[str, Any], name: str, called: str) -> list[Any]:
    """A field that is a list; empty where it is missing."""
    value = message.get(name)
    if value is None:
        return []
    if not isinstance(value, list):
        raise InputError(f"{called} has {name} = {brief(value)}; give a list")
    return value


def numbers(value: Any, width: int | None, called: str) -> np.ndarray:
    """A list of finite numbers, `width` of them unless that is None."""
    listed = value if isinstance(value, list) else []
    array = np.array([_number(x) for x in listed], float)
    with np.errstate(over="ignore"):  # what is too large for single precision is infinite there
        finite = np.isfinite(array.astype(np.float32)).all()
    if finite and isinstance(value, list) and width in (None, len(array)):
        return array
    many = "a list of" if width is None else f"a list of {width}"
    raise InputError(f"{called} = {brief(value)}; give {many} finite numbers")


def _number(value: Any) -> float:
    """YAML 1.1 takes 1e-05 for a string; booleans would pass for numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return np.nan
    try:
        return float(value)
    except (ValueError, OverflowError):
        return np.nan


def components(value: Any, axes: str, called: str) -> np.ndarray:
    """A vector, as a list or as fields that are called like its axes."""
    if isinstance(value, dict):
        fields = fields_of(value, axes, called)
        value = [fields.get(axis) for axis in axes]
    return numbers(value, len(axes), called)


def pose_of(
    value: Any,
    called: str,
    names: tuple[str, str] = ("position", "orientation"),
    *,
    may_be_unset: bool = False,
) -> Pose:
    """A pose, with its quaternion in the order x y z w, as lists or as fields x, y, z (and w).

    Args:
        value: of the message.
        called: in error messages.
        names: of its two fields.
        may_be_unset: a quaternion of zeros, as fields have that nobody set, is no rotation.
    """
    fields = fields_of(value, names, called)
    parts = []
    for name, axes in zip(names, ("xyz", "xyzw"), strict=True):
        parts.append(components(fields.get(name), axes, f"{name} of {called}"))
    position, (x, y, z, w) = parts
    quat = np.array([w, x, y, z])
    if np.abs(quat).max() < 1e-3:
        if not may_be_unset:
            raise InputError(f"{names[1]} of {called} is zeros; give a rotation as x y z w")
        quat[0] = 1.0
    return Pose(position, unit_quats(quat))
