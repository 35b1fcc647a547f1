"""Folders of MoveIt's YAML files, as MotionBenchMaker's problems are published, as problem sets."""

import re
from pathlib import Path

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.problems.moveit import problem_from_moveit
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.scene import pad_scene

_SCENE_FILE = re.compile(r"(?:(?P<scene>.+)_)?scene(?P<number>\d+)\.yaml")
_ROBOTS = re.compile(r"_(panda|fetch|ur5|baxter)$")  # how the published folders end


def problems_of_folder(folder: Path, robot: Robot) -> ProblemSet:
    """Reads all problems below a folder: SCENE_ROBOT/sceneNNNN.yaml, or SCENE_sceneNNNN.yaml, each
    beside the request of its number.

    Raises:
        InputError: there are none, a request is missing, or a file cannot be read.
    """
    found = []
    for path in sorted(folder.rglob("*.yaml")):
        match = _SCENE_FILE.fullmatch(path.name)
        if match is None:
            continue
        scene = match["scene"] or _ROBOTS.sub("", path.parent.name)
        prefix = f"{match['scene']}_" if match["scene"] else ""
        request = path.with_name(f"{prefix}request{match['number']}.yaml")
        problem = problem_from_moveit(path, request, robot)
        found.append((scene, int(match["number"]), problem))
    if not found:
        raise InputError(f"no sceneNNNN.yaml below {str(folder)!r}; name the published folder")
    found.sort(key=lambda each: each[:2])
    most = max(len(problem.scene.mask) for *_, problem in found)
    problems = [problem._replace(scene=pad_scene(problem.scene, most)) for *_, problem in found]
    stacked: Problem = jax.tree.map(lambda *x: np.stack(x), *problems)
    extras = {
        "scene": np.array([scene for scene, *_ in found]),
        "index": np.array([number for _, number, _ in found]),
    }
    return ProblemSet(robot.name, stacked, extras)
