"""The same seeds give the same plans as when tests/data/plans.json was written.

A change that is meant to change plans writes it anew: `python -m tests.test_equal_results`. With
three hundred problems of the Kuka and all planners, `tests/equal_results.py` compares two versions
on one machine; "guided" is not among those here, since its network's rounding, which is another on
another processor, decides between paths that are nearly equal.
"""

import json
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import make_scene
from tests.conftest import TINY
from tests.equal_results import differences, plan_all

GOLDEN = Path(__file__).parent / "data" / "plans.json"
PLANNERS = ("lazysp", "distance")
OPTIONS = {"num_nodes": 40, "max_roadmaps": 2}


def draw_problems(robot, num=6):
    """Problems among boxes that are not rotated."""
    rng, problems = np.random.default_rng(5), []
    while len(problems) < num:
        centers = rng.uniform(-0.8, 0.8, (6, 3))
        centers *= np.maximum(1, 0.5 / np.linalg.norm(centers, axis=1))[:, None]
        scene = make_scene(centers, rng.uniform(0.05, 0.22, (6, 3)))
        ends = rng.uniform(robot.joint_lower, robot.joint_upper, (2, 3)).astype(np.float32)
        # Far enough from contact that another processor's rounding decides nothing.
        if min(configuration_clearance(robot, scene, q) for q in ends) > 1e-3:
            problems.append(Problem(ends[0], ends[1], scene))
    return jax.tree.map(lambda *x: np.stack(x), *problems)


@pytest.mark.parametrize("name", PLANNERS)
def test_plans_are_those_of_before(tiny_path, name):
    problems = draw_problems(load_robot(tiny_path))
    found = plan_all(str(tiny_path), name, problems, 6, **OPTIONS)
    assert sum(row["success"] for row in found) >= 4
    assert differences(json.loads(GOLDEN.read_text())[name], found, tolerance=1e-4) == []


def test_a_difference_is_found():
    before = json.loads(GOLDEN.read_text())["lazysp"]
    after = json.loads(GOLDEN.read_text())["lazysp"]
    solved = next(i for i, row in enumerate(after) if row["success"])
    after[solved]["path"][0][0] += 1e-3
    assert differences(before, after, tolerance=1e-4) == [solved]
    after = json.loads(GOLDEN.read_text())["lazysp"]
    after[solved]["edge_checks"] += 1
    assert differences(before, after) == [solved]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        arm = Path(folder) / "tiny.xml"
        arm.write_text(TINY)
        drawn = draw_problems(load_robot(arm))
        plans = {name: plan_all(str(arm), name, drawn, 6, **OPTIONS) for name in PLANNERS}
    GOLDEN.write_text(json.dumps(plans) + "\n")
    sys.exit(0)
