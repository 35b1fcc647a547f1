"""Problems in strata, from easy to hard: by their straight line, their boxes, their clearance."""

from pathlib import Path

import jax
import numpy as np

from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import EDGE_RESOLUTION
from gnnjax.collision.clearances import path_clearance
from gnnjax.problems.shards import load_problems

LINES = ("line free", "line blocked")
# Upper ends of the strata: boxes, and clearance in m.
BOXES = {"2-3 boxes": 3, "4-5 boxes": 5, "6-7 boxes": 7, "8-9 boxes": 9}
CLEARANCES = {"< 1 cm": 0.01, "1-3 cm": 0.03, "3-6 cm": 0.06, "> 6 cm": np.inf}


def strata(robot_name: str, path: Path, rows: list[dict]) -> dict[str, np.ndarray]:
    """Which problems belong to which stratum, `[P]` each.

    Args:
        robot_name: of the arm, or path of an MJCF.
        path: of the problem set.
        rows: results of PRM on its first P problems, for the narrowness of the way. Problems that
            it does not solve are a stratum of their own.
    """
    robot = load_robot(robot_name)
    problems = load_problems(path, robot).take(slice(len(rows))).problems
    hard = np.array([row["hard"] for row in rows])
    boxes = problems.scene.mask.sum(axis=1)
    clearances = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        if row["success"]:
            scene = jax.tree.map(lambda x, i=i: x[i], problems.scene)
            clearances[i] = path_clearance(robot, scene, np.array(row["path"]), EDGE_RESOLUTION)
    return {
        **dict(zip(LINES, (~hard, hard), strict=True)),
        **split(boxes, BOXES),
        **split(clearances, CLEARANCES),
        "no path in\nPRM's roadmaps": np.isnan(clearances),
    }


def split(values: np.ndarray, upper: dict[str, float]) -> dict[str, np.ndarray]:
    """Splits values at upper ends, each of which belongs to its stratum; NaN is in none."""
    low, strata = -np.inf, {}
    for name, high in upper.items():
        strata[name] = (values > low) & (values <= high)
        low = high
    return strata
