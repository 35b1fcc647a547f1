"""The experiment that carries out what is planned."""

import json

import jax
import numpy as np
import pytest
from scipy.stats import binomtest

from experiments import real_arm
from experiments.carried_out import summarize, turnings
from experiments.real_arm import RealArmConfig, carry_out
from experiments.record import run
from experiments.registry import EXPERIMENTS
from experiments.statistics import proportion
from gnnjax.arm.robot import load_robot
from gnnjax.planning.load import load_planner
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.scene import make_scene
from tests.conftest import TINY

MOTORS = "".join(f'<motor joint="{j}" forcerange="-40 40"/>' for j in "abc")
LIMITED = TINY.replace(
    "</mujoco>",
    f"""<custom><numeric name="velocity_limit" data="2 2 2"/>
    <numeric name="acceleration_limit" data="8 8 8"/></custom>
    <actuator>{MOTORS}</actuator></mujoco>""",
)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "limited.xml"
    path.write_text(LIMITED)
    return path


def problems_of():
    """Two problems that are free, and one whose start is too near to a box."""
    scenes = [
        make_scene([[0.6, 0.0, 0.5]], [[0.05] * 3]),
        make_scene([[-0.6, 0.0, 0.0]], [[0.05] * 3]),
        make_scene([[0.68, 0.15, 0.0]], [[0.05] * 3]),
    ]
    starts = np.array([[-1.0, 0, 0], [0.5, 0.2, 0], [0.1, 0, 0]], np.float32)
    goals = np.array([[1.0, 0, 0], [-0.5, 0.5, 0.3], [1.0, 0, 0]], np.float32)
    return Problem(starts, goals, jax.tree.map(lambda *x: np.stack(x), *scenes))


def test_the_quick_form_writes_results_and_goes_on(arm, tmp_path, monkeypatch):
    planned = []

    def stand_in(robot, case):
        planned.append(case.planner)
        return load_planner(arm, "lazysp", num_nodes=30, margin=case.margin)

    def saved(config, robot, *, family, num_problems):
        assert num_problems == 3
        path = tmp_path / f"{family}.npz"
        save_problems(path, ProblemSet(load_robot(arm).name, problems_of()))
        return path

    monkeypatch.setattr(real_arm, "make_planner", stand_in)
    monkeypatch.setattr(real_arm, "problem_set", saved)
    experiment = EXPERIMENTS["real_arm"]
    config = RealArmConfig(quick=True, robot=str(arm), runs=tmp_path, results=tmp_path / "out")
    quick = experiment._replace(quick={**experiment.quick, "payloads": (0.5,)})
    results = run(quick, config)
    assert planned == ["guided", "ompl:rrt_connect"]
    assert results == run(quick, config)
    assert len(planned) == 2
    for row in results["rows"]:
        assert (row["num_problems"], row["accepted"], row["found"], row["timed"]) == (3, 2, 2, 2)
        assert (row["payload"], row["suitable"], row["touched"]) == (0.5, 2, 0)
    assert "limited | paper | RRT-Connect, simplified | 0.5 | 2 | 2" in experiment.table(results)
    assert "Holds in part: limited: RRT-Connect's" in experiment.verdict(results)
    kept = json.loads(next(tmp_path.rglob("guided_0.5.json")).read_text())
    assert [row["accepted"] for row in kept] == [True, True, False]
    assert (tmp_path / "out" / "real_arm.png").exists()


def test_motions_that_touch_are_not_suitable_and_paths_in_collision_are_not_timed(arm):
    robot, problems = load_robot(arm), problems_of()
    scenes = problems.scene._replace(centers=np.full_like(problems.scene.centers, 3.0))
    path = [[-1.0, 0, 0], [1.0, 0, 0]]
    config = RealArmConfig(mass_error=0.0, friction=0.0, delay=0.0)
    plans = [{"accepted": True, "path": x} for x in (path, None, path)]
    scenes.centers[2, 0] = [0.68, 0.15, 0.0]
    rows = carry_out(config, robot, problems._replace(scene=scenes), plans)
    assert [row["timed"] for row in rows] == [True, False, False]
    assert "not certified" in rows[2]["reason"]
    assert rows[0]["suitable"]
    assert summarize(rows)["suitable_share"]["mean"] == pytest.approx(1 / 3)


def test_turnings_are_counted_and_small_movements_are_none():
    t = np.linspace(0, 1, 400)
    rows = [t, -t, np.sin(2 * np.pi * t), np.cos(6 * np.pi * t), 0.02 * np.sin(90 * t), 0 * t]
    noise = 0.01 * np.random.default_rng(0).normal(size=(400, 6))
    assert turnings(np.stack(rows, axis=1)).tolist() == [0, 0, 2, 5, 0, 0]
    assert turnings(np.stack(rows, axis=1) + noise, small=0.12).tolist() == [0, 0, 2, 5, 0, 0]


def test_proportions_have_intervals_of_wilson():
    for count, of in ((8, 10), (0, 5), (90, 90)):
        expected = binomtest(count, of).proportion_ci(method="wilson")
        found = proportion(count, of)
        assert found is not None
        assert found["mean"] == count / of
        assert (found["low"], found["high"]) == pytest.approx(tuple(expected), abs=1e-6)
    assert proportion(0, 0) is None
