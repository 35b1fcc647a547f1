"""The campaign against certified curves finds nothing, and would find a certificate that errs."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments import certify_curves, turns
from experiments.certify_curves import CurvesConfig, measure_block, run
from experiments.judge import Arm
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_path
from gnnjax.planning.query import make_plan


class Random:
    """A planner that tries paths of three edges."""

    def __init__(self, robot):
        self.robot = robot

    def plan_batch(self, problems, *, seed):
        rng, plans = np.random.default_rng(seed), []
        for i, (start, goal) in enumerate(zip(problems.start, problems.goal, strict=True)):
            scene, path = jax.tree.map(lambda x, i=i: x[i], problems.scene), None
            for _ in range(30):
                span = 0.6 * self.robot.joint_lower, 0.6 * self.robot.joint_upper
                tried = np.stack([start, *rng.uniform(*span, (2, len(start))), goal])
                if certify_path(self.robot, scene, tried):
                    path = tried
                    break
            plans.append(make_plan(path, "none found", len(start), **dict.fromkeys(COSTS, 0)))
        return plans


COSTS = "edge_checks sampling_checks search_checks planning_time_s total_time_s roadmaps".split()


@pytest.fixture(scope="module", autouse=True)
def few(tiny_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certify_curves, "SHIPPED", (str(tiny_path),))
        patch.setattr(certify_curves, "_BLOCK", 8)
        patch.setattr(certify_curves, "make_planner", lambda robot, _: Random(robot))
        yield


def test_certified_curves_survive_a_scan_and_graze(tmp_path, tiny_path):
    config = CurvesConfig(
        num_problems=8, step=0.02, seed=0, runs=tmp_path, json=tmp_path / "all.json"
    )
    found = run(config)["all"]
    assert found["problems"] == 8
    assert found["refuted"] == 0
    assert found["corners"] == found["pushed"] == 2 * found["solved"] - found["stops"]
    assert found["straight"] > found["solved"] > 3
    assert found["within_2mm"] >= 3
    assert run(config)["all"] == found  # from what is there


def test_curves_that_an_older_certificate_went_through_do_not_count(tmp_path, monkeypatch):
    measured = []

    def measure_once(arm, planner, seed, step):
        measured.append(seed)
        counts = dict.fromkeys((*certify_curves._COUNTS, "seconds"), 1)
        return counts | {"gaps": [], "least": 1.0, "refuted": []}

    monkeypatch.setattr(certify_curves, "measure_block", measure_once)
    config = CurvesConfig(num_problems=16, runs=tmp_path, json=tmp_path / "all.json")
    for code, num in (("old", 2), ("old", 2), ("new", 4)):
        monkeypatch.setattr(turns, "code_digest", lambda code=code: code)
        assert run(config)["all"]["problems"] == 2
        assert len(measured) == num
    assert run(dataclasses.replace(config, num_problems=24))["all"]["problems"] == 3
    assert len(measured) == 5


@pytest.mark.usefixtures("bounds_too_low")
def test_a_certificate_that_bounds_motion_too_low_is_refuted(tiny_path):
    robot = load_robot(tiny_path)
    found = measure_block(Arm(robot, reach=0.7), Random(robot), (1,), 0.02)
    assert len(found["refuted"]) >= 2
    assert {row["kind"] for row in found["refuted"]} <= {"plain", "pushed"}
