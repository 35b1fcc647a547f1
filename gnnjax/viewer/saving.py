"""The texts that a viewer saves: a scene, and how its query is planned by the command."""

import dataclasses
import shlex
import tempfile
from pathlib import Path

import numpy as np

from gnnjax.planning.options import PlannerOptions
from gnnjax.scene.scene import Scene
from gnnjax.scene.scene_file import scene_to_json
from gnnjax.trajectory.options import MotionOptions
from gnnjax.viewer.session import ENDS, Session

SCENE_FILE = "scene.json"
MOTION_FILE = "motion.npz"


def scene_text(scene: Scene) -> str:
    """A scene as a file that `scene_from_json` reads.

    Raises:
        InputError: see `scene_to_json`.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / SCENE_FILE
        scene_to_json(scene, file)
        return file.read_text(encoding="utf-8")


def query_text(session: Session, options: PlannerOptions | MotionOptions, **others: object) -> str:
    """The arguments of `python -m gnnjax.plan` that plan the query in the saved scene, and write
    its motion where options of motions are named.

    Args:
        session: whose query it is.
        options: of planner and motion; those that are not as they would be anyway are named.
        others: options besides, that are named if they are not None.
    """
    named = {name: value for name, value in others.items() if value is not None}
    for kind in (PlannerOptions, MotionOptions):
        for field in dataclasses.fields(kind):
            value = getattr(options, field.name)
            # Clearance the command always tells.
            if value != field.default and field.name != "clearance":
                named[field.name] = value
                if kind is MotionOptions:  # which the command takes with a motion alone
                    named["trajectory"] = MOTION_FILE
    words = ["--scene", SCENE_FILE]
    for end in ENDS:
        words += [f"--{end}", *(_number(x) for x in session.end(end))]
    for name, value in named.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", *_words(value)]
    return shlex.join(words) + "\n"


def _words(value: object) -> list[str]:
    if isinstance(value, float):
        return [_number(value)]
    if isinstance(value, tuple | list | np.ndarray):
        return [word for each in value for word in _words(each)]
    return [str(value)]


def _number(value: float | np.floating) -> str:
    """As few digits as tell it from all others, without an exponent, which a command line would
    take for the name of an option if it is negative."""
    if not np.isfinite(value):
        return str(float(value))
    return np.format_float_positional(value, trim="-")
