"""Scenes as JSON, for people to write by hand."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gnnjax.errors import InputError, brief
from gnnjax.files import atomic_write
from gnnjax.scene.scene import Scene, box_bucket, scene_from_shapes
from gnnjax.scene.shapes import (
    FIELDS,
    IDENTITY_QUAT,
    KINDS,
    Shape,
    Sums,
    described,
    for_every_kind,
    kind_of,
)

# The lists of a scene file.
_LISTS = for_every_kind(
    "scene file",
    box="boxes",
    sphere="spheres",
    capsule="capsules",
    cylinder="cylinders",
    half_space="half_spaces",
)


def scene_from_json(path: str | Path) -> Scene:
    """Reads lists of obstacles: `{"boxes": [{"center": [x,y,z], "half_extents": [x,y,z]}], ...}`.

    There may be `boxes` (`center`, `half_extents`), `spheres` (`center`, `radius`), `capsules` and
    `cylinders` (`center`, `radius`, `half_length`; about their z axis), each of which but spheres
    may have a `quat` (w, x, y, z), and `half_spaces` (`point`, `normal`). All lengths in m.

    Raises:
        InputError: the file is missing, is no JSON, holds anything else, or an obstacle lacks what
            it needs.
    """
    called = f"scene file {str(path)!r}"
    data = read_json(path, "scene file")
    if not isinstance(data, dict) or not data:
        raise InputError(
            f'{called} holds no list of obstacles; write {{"boxes": [...]}} or others of '
            f"{list(_LISTS.values())}"
        )
    return scene_from_shapes(shapes_of(data, called, repr(str(path))), source=repr(str(path)))


def read_json(path: str | Path, what: str) -> Any:
    """What a JSON file holds.

    Args:
        path: of the file.
        what: it should be, for error messages.

    Raises:
        InputError: no such file, or no JSON.
    """
    called = f"{what} {str(path)!r}"
    try:
        text = Path(path).read_text(encoding="utf-8")
        return json.loads(text, object_pairs_hook=_unrepeated)
    except FileNotFoundError:
        raise InputError(f"no {called}; check the path") from None
    except IsADirectoryError:
        raise InputError(f"{called} is a folder; name a file") from None
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, or nested without end
        raise InputError(f"{called} is no JSON: {error}; mend it") from None


def shapes_of(data: dict[str, Any], called: str, short: str) -> list[Shape]:
    """The obstacles in the lists of a file.

    Args:
        data: the lists, by their names.
        called: the file, in error messages.
        short: the same, in those of one obstacle.

    Raises:
        InputError: another list, too many obstacles, or one that lacks what it needs.
    """
    known = list(_LISTS.values())
    # What is not read would be planned through.
    if unknown := sorted(data.keys() - set(known)):
        raise InputError(
            f"{called} has {unknown}, and there are only {known}; enclose such "
            "obstacles in one of those, and remove what is none"
        )
    for name, listed in data.items():
        if not isinstance(listed, list):
            raise InputError(f"{called} has {name} = {brief(listed)}; give a list")
    box_bucket(sum(map(len, data.values())), called)  # too many are refused before each is read
    return [
        Shape(kind, _checked(kind, values, f"{kind} {i} of {short}"))
        for kind, name in _LISTS.items()
        for i, values in enumerate(data.get(name, []))
    ]


def _unrepeated(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object as a dict; of a name that comes twice, JSON would drop the first value."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{max(names, key=names.count)!r} comes twice in one object")
    return found


def _checked(kind: str, values: Any, called: str) -> dict[str, Any]:
    fields = FIELDS[kind]
    needed = [name for name in fields if name != "quat"]
    # A misspelled "quat" must not leave an obstacle unrotated.
    if not isinstance(values, dict) or not values.keys() <= fields.keys():
        found = brief(sorted(values) if isinstance(values, dict) else values)
        turned = " and, if rotated, quat" if "quat" in fields else ""
        raise InputError(f"{called} has {found}; give {', '.join(needed)}{turned}")
    for name, width in fields.items():
        if name == "quat" and name not in values:
            continue
        value = values.get(name)
        listed = [value] if width == 1 else value
        # Booleans and strings would pass for numbers in NumPy.
        numbers = isinstance(listed, list) and all(type(x) in (int, float) for x in listed)
        if not numbers or len(listed) != width:
            wanted = "a number" if width == 1 else f"a list of {width} numbers"
            raise InputError(f"{called} has {name} = {brief(value)}; give {wanted}")
    return {"quat": IDENTITY_QUAT, **values} if "quat" in fields else values


def scene_to_json(scene: Scene, path: str | Path) -> None:
    """Writes the existing obstacles of one scene as JSON that `scene_from_json` reads."""
    one = jax.tree.map(lambda x: np.asarray(x)[np.asarray(scene.mask)], scene)
    kinds = kind_of(one.half_extents, one.radii)
    if (kinds < 0).any():
        raise InputError(
            f"obstacle {int((kinds < 0).argmax())} of the scene is of no kind of {list(KINDS)}; "
            "make scenes with make_scene or scene_from_shapes"
        )
    lists: dict[str, list] = {}
    for number, kind in enumerate(KINDS):
        chosen = Sums(*(x[kinds == number] for x in one[:4]))
        columns = described(kind, chosen)
        found = [
            {
                name: value.tolist() if FIELDS[kind][name] > 1 else float(value[0])
                for name, value in zip(columns, row, strict=True)
            }
            for row in zip(*columns.values(), strict=True)
        ]
        if found or kind == "box":
            lists[_LISTS[kind]] = found
    text = json.dumps(lists, indent=1)
    atomic_write(path, lambda file: file.write_text(text + "\n", encoding="utf-8"))
