"""Scenes as JSON, for people to write by hand."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief
from gnnjax.files import atomic_write
from gnnjax.scene.allowed import allow_contacts, refuse_allowed
from gnnjax.scene.cloud import Balls, point_cloud
from gnnjax.scene.numbers import number_of
from gnnjax.scene.octomap import octomap
from gnnjax.scene.own_points import MARGIN, without_robot
from gnnjax.scene.point_files import points_from_file
from gnnjax.scene.scene import Scene, check_single, obstacle_bucket, scene_from_shapes
from gnnjax.scene.shapes import (
    FIELDS,
    IDENTITY_QUAT,
    KINDS,
    Shape,
    Sums,
    described,
    for_every_kind,
    known_kinds,
)
from gnnjax.scene.surfaces import height_field, mesh

# The lists of a scene file.
_LISTS = for_every_kind(
    "scene file",
    box="boxes",
    sphere="spheres",
    capsule="capsules",
    cylinder="cylinders",
    half_space="half_spaces",
)


# The lists of what has other forms: what each entry needs, and what it may have.
_CLOUDS = {
    "clouds": (("points",), ("radius", "voxel", "without_robot_at", "margin")),
    "meshes": (("file",), ("center", "quat", "scale", "voxel", "solid")),
    "height_fields": (("heights", "size"), ("center", "quat", "depth", "voxel")),
    "octomaps": (("file",), ("center", "quat")),
}


def scene_from_json(path: str | Path, robot: Robot | None = None) -> Scene:
    """Reads lists of obstacles: `{"boxes": [{"center": [x,y,z], "half_extents": [x,y,z]}], ...}`.

    There may be `boxes` (`center`, `half_extents`), `spheres` (`center`, `radius`), `capsules` and
    `cylinders` (`center`, `radius`, `half_length`; about their z axis), each of which but spheres
    may have a `quat` (w, x, y, z), and `half_spaces` (`point`, `normal`). All lengths in m.

    And there may be `clouds` (`points`: a list, or a file of `points_from_file`; `radius` and
    `voxel`, see `point_cloud`; `without_robot_at`, a configuration, and `margin`, see
    `without_robot`), `meshes` (`file` and what else `mesh` takes), `height_fields` (`heights`: a
    list of rows, or a .npy file; and what else `height_field` takes) and `octomaps` (`file`,
    `center`, `quat`). Names of files are relative to the folder of the JSON.

    And `allow`, a list of contacts that are meant: `["hand", "cylinder 0"]`, see `allow_contacts`.

    Args:
        path: of the file.
        robot: the arm, whose bodies `allow` names, and whose own points are taken out of clouds.

    Raises:
        InputError: the file is missing, is no JSON, holds anything else, or an obstacle lacks what
            it needs; or it allows contacts, and they are none; or it needs an arm for that or for
            `without_robot_at`, and none is given.
    """
    called = f"scene file {str(path)!r}"
    data = read_json(path, "scene file")
    if not isinstance(data, dict) or not data:
        raise InputError(
            f'{called} holds no list of obstacles; write {{"boxes": [...]}} or others of '
            f"{[*_LISTS.values(), *_CLOUDS]}"
        )
    short = repr(str(path))
    clouds = [
        _read_cloud(name, values, Path(path).parent, f"{name} {i} of {short}", robot)
        for name in _CLOUDS
        for i, values in enumerate(_listed(data.pop(name, []), name, called))
    ]
    clouds = [balls for balls in clouds if balls is not None]
    allow = _listed(data.pop("allow", []), "allow", called)
    scene = scene_from_shapes(
        shapes_of(data, (*_CLOUDS, "allow"), called, short), clouds=clouds, source=short
    )
    if not allow:
        return scene
    if robot is None:
        raise InputError(
            f"{called} has allow, contacts that are meant of an arm's bodies; say of which arm, "
            "scene_from_json(path, robot)"
        )
    return allow_contacts(robot, scene, allow)


def _listed(value: Any, name: str, called: str) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{called} has {name} = {brief(value)}; give a list")
    return value


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


def shapes_of(data: dict[str, Any], others: Sequence[str], called: str, short: str) -> list[Shape]:
    """The obstacles in the lists of a file.

    Args:
        data: the lists, by their names.
        others: names of what else such a file may have, which is not among them.
        called: the file, in error messages.
        short: the same, in those of one obstacle.

    Raises:
        InputError: another list, too many obstacles, or one that lacks what it needs.
    """
    known = list(_LISTS.values())
    # What is not read would be planned through.
    if unknown := sorted(data.keys() - set(known)):
        raise InputError(
            f"{called} has {unknown}, and there are only {[*known, *others]}; enclose such "
            "obstacles in one of those, and remove what is none"
        )
    for name, listed in data.items():
        _listed(listed, name, called)
    obstacle_bucket(
        sum(map(len, data.values())), called
    )  # too many are refused before each is read
    return [
        Shape(kind, _checked(kind, values, f"{kind} {i} of {short}"))
        for kind, name in _LISTS.items()
        for i, values in enumerate(data.get(name, []))
    ]


def _read_cloud(
    name: str, values: Any, folder: Path, called: str, robot: Robot | None
) -> Balls | None:
    """What stands in an entry of a list; None where all points of it are on the robot."""
    needed, optional = _CLOUDS[name]
    if not isinstance(values, dict) or not set(needed) <= values.keys() <= {*needed, *optional}:
        found = brief(sorted(values) if isinstance(values, dict) else values)
        raise InputError(
            f"{called} has {found}; give {', '.join(needed)} and, if wanted, {', '.join(optional)}"
        )
    given = dict(values)
    for key in given.keys() & {"radius", "voxel", "scale", "depth", "margin"}:
        if given[key] is None and (name, key) == ("clouds", "voxel"):
            continue
        given[key] = number_of(given[key], f"{called} has {key}")
    if not isinstance(given.get("solid"), bool | None):
        raise InputError(f"{called} has solid = {brief(given['solid'])}; give true or false")
    for key in given.keys() & {"center", "quat", "size", "without_robot_at"}:
        if not isinstance(given[key], list):
            raise InputError(f"{called} has {key} = {brief(given[key])}; give a list of numbers")
    first = given.pop(needed[0])
    if not isinstance(first, str) and (needed[0] == "file" or not isinstance(first, list)):
        either = "" if needed[0] == "file" else ", or a list"
        raise InputError(
            f"{called} has {needed[0]} = {brief(first)}; give the name of a file{either}"
        )
    if isinstance(first, str):
        file = folder / first
        if needed[0] == "file":
            return (mesh if name == "meshes" else octomap)(file, **given)
        first = points_from_file(file) if name == "clouds" else _numbers_of(file, called)
    if name == "clouds":
        if given.keys() & {"without_robot_at", "margin"}:
            first = _without_robot(first, given, called, robot)
            if not len(first):
                return None
        return point_cloud(first, **given, source=called)
    return height_field(first, **given)


def _without_robot(
    points: Any, given: dict[str, Any], called: str, robot: Robot | None
) -> np.ndarray:
    """The points of a cloud, less the robot's; takes from `given` what says which these are."""
    if "without_robot_at" not in given:
        raise InputError(f"{called} has a margin, which is one to the robot; add without_robot_at")
    if robot is None:
        raise InputError(
            f"{called} has without_robot_at; say which arm was there, scene_from_json(path, robot)"
        )
    q = given.pop("without_robot_at")
    return without_robot(points, robot, q, given.pop("margin", MARGIN), source=called)


def _numbers_of(file: Path, called: str) -> np.ndarray:
    try:
        return np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{called} names {str(file)!r}, which is no .npy file: {error}") from None


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
    """Writes the existing obstacles of one scene as JSON that `scene_from_json` reads.

    Raises:
        InputError: no scene, several in one, or one in which contacts are meant.
    """
    check_single(scene)
    refuse_allowed(scene, "a scene file without an arm")
    kinds = known_kinds(scene.half_extents, scene.radii, scene.mask)
    lists: dict[str, list] = {}
    for number, kind in enumerate(KINDS):
        chosen = Sums(*(np.asarray(x)[kinds == number] for x in scene[:4]))
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
    if scene.cloud is not None and int(scene.cloud.num):
        points = np.asarray(scene.cloud.points)[: int(scene.cloud.num)]
        cloud = {"points": points.tolist(), "radius": float(scene.cloud.radius), "voxel": None}
        lists["clouds"] = [cloud]
    text = json.dumps(lists, indent=1)
    atomic_write(path, lambda file: file.write_text(text + "\n", encoding="utf-8"))
