"""Scenes from files of any kind, told by their endings."""

from pathlib import Path

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.scene.from_mjcf import mjcf_holds, scene_from_mjcf
from gnnjax.scene.moveit import scene_from_moveit
from gnnjax.scene.octomap import scene_from_octomap
from gnnjax.scene.scene import Scene
from gnnjax.scene.scene_file import scene_from_json


def _mjcf(path: Path, robot: Robot) -> Scene:
    return scene_from_mjcf(path, robot=robot if mjcf_holds(path, robot) else None)


def _moveit(path: Path, robot: Robot) -> Scene:
    return scene_from_moveit(path)


def _json(path: Path, robot: Robot) -> Scene:
    return scene_from_json(path, robot)


def _octomap(path: Path, robot: Robot) -> Scene:
    return scene_from_octomap(path)


_READERS = {
    ".json": _json,
    ".yaml": _moveit,
    ".yml": _moveit,
    ".xml": _mjcf,
    ".bt": _octomap,
    ".ot": _octomap,
}


def is_moveit(path: Path) -> bool:
    """Whether a file is read as a planning scene of MoveIt."""
    return _READERS.get(path.suffix.lower()) is _moveit


def read_scene(path: Path, robot: Robot) -> Scene:
    """Reads a scene: lists (.json), MoveIt's planning scene (.yaml), a MuJoCo model (.xml) or an
    octomap (.bt, .ot).

    Args:
        path: of the file.
        robot: the arm, which is left out where a MuJoCo model holds it, and whose bodies lists of
            allowed contacts name.

    Raises:
        InputError: another ending, or see `scene_from_json`, `scene_from_moveit`,
            `scene_from_mjcf`, `scene_from_octomap`.
    """
    if path.suffix.lower() not in _READERS:
        raise InputError(
            f"scene file {str(path)!r} has the ending {path.suffix!r}; give .json (lists of "
            "obstacles), .yaml (a planning scene of MoveIt), .xml (a MuJoCo model), .bt or .ot (an "
            "octomap)"
        )
    return _READERS[path.suffix.lower()](path, robot)
