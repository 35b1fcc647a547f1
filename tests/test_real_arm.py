"""The experiment that carries out what is planned."""

import json

import jax
import numpy as np
import pytest
from scipy.stats import binomtest

from experiments import real_arm_parts
from experiments.carried_out import Conditions, carry_out, summarize, turnings
from experiments.real_arm import RealArmConfig
from experiments.real_arm_parts import find_paths, measure_part
from experiments.record import run
from experiments.registry import EXPERIMENTS
from experiments.statistics import proportion
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.planning.load import load_planner
from gnnjax.planning.query import make_plan
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import make_scene
from gnnjax.trajectory.simulate import ModelErrors
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


@pytest.mark.usefixtures("small_figures")
def test_the_quick_form_writes_results_and_goes_on(arm, tmp_path, monkeypatch):
    planned = []

    def stand_in(robot, case):
        planned.append(case.planner)
        return load_planner(arm, "lazysp", num_nodes=30, margin=case.margin)

    monkeypatch.setattr(real_arm_parts, "make_planner", stand_in)
    monkeypatch.setattr(real_arm_parts, "draw_problems", lambda *of: problems_of())
    experiment = EXPERIMENTS["real_arm"]
    config = RealArmConfig(quick=True, robot=str(arm), runs=tmp_path, results=tmp_path / "out")
    quick = experiment._replace(quick={**experiment.quick, "payloads": (0.5,)})
    results = run(quick, config)
    assert planned == ["guided", "ompl:rrt_connect"]
    assert results == run(quick, config)
    assert len(planned) == 2
    for row in results["rows"]:
        # Of the second draw of three, the first alone.
        assert (row["drawn"], row["accepted"], row["found"], row["held"]) == (4, 3, 3, 3)
        assert (row["payload"], row["suitable"], row["touched"]) == (0.5, 3, 0)
    assert "limited | paper | RRT-Connect, simplified | 0.5 | 4 | 3 | 3 | 3" in experiment.table(
        results
    )
    assert "Holds in part: limited: RRT-Connect's" in experiment.verdict(results)
    assert "of 6 motions none touched anything" in experiment.verdict(results)
    kept = [json.loads(path.read_text()) for path in tmp_path.rglob("guided_0.5.json")]
    assert list(map(len, kept)) == [2, 2]
    assert (tmp_path / "out" / "real_arm.png").exists()


def test_parts_are_of_the_very_arm(arm, tmp_path, monkeypatch):
    told = []

    def folder_of(runs, name, settings, *files):
        told.extend(files)
        raise InputError("enough")

    monkeypatch.setattr("experiments.real_arm.folder_of", folder_of)
    config = RealArmConfig(quick=True, robot=str(arm), runs=tmp_path, results=tmp_path)
    with pytest.raises(InputError, match="enough"):
        run(EXPERIMENTS["real_arm"], config)
    assert told == [arm]


def test_paths_that_the_arm_cannot_hold_are_planned_again(arm, tmp_path, monkeypatch):
    planned = []

    def stand_in(robot, case):
        planned.append(robot.rest_limit)
        return load_planner(robot, "lazysp", num_nodes=60, margin=case.margin)

    monkeypatch.setattr(real_arm_parts, "PLANNERS", ("guided",))
    monkeypatch.setattr(real_arm_parts, "make_planner", stand_in)
    scenes = [make_scene([[-0.6, 0.0, 0.0]], [[0.05] * 3])] * 2
    # The straight line leads the first one through 4.4 N m in its second joint, of which it has 4.
    starts = np.array([[0, -1.2, 0], [0.5, -1.5, 0]], np.float32)
    goals = np.array([[0, 1.2, 0], [-0.5, -1.5, 0]], np.float32)
    problems = Problem(starts, goals, jax.tree.map(lambda *x: np.stack(x), *scenes))
    monkeypatch.setattr(real_arm_parts, "draw_problems", lambda *of: problems)
    conditions = Conditions(0.02, 0.9, ModelErrors())
    part = measure_part(tmp_path, str(arm), "paper", 0, 2, (0.0,), conditions, 0)
    (rows,) = part.rows.values()
    assert [row["timed"] for row in rows] == [True, True]
    assert [row.get("again", False) for row in rows] == [True, False]
    assert planned[0] is None
    np.testing.assert_allclose(planned[1], [4.0] * 3)
    assert summarize(rows)["again"] == 1


def test_draws_that_never_have_the_margin_end(arm, tmp_path, monkeypatch):
    monkeypatch.setattr(real_arm_parts, "draw_problems", lambda *of: problems_of())
    config = RealArmConfig(quick=True, robot=str(arm), runs=tmp_path, margin=0.7, draws=2)
    with pytest.raises(InputError, match=r"margin is 0\.7, which the ends of no problem have"):
        run(EXPERIMENTS["real_arm"], config)


def test_the_path_that_turns_back_least_is_taken_and_swings_are_planned_anew(monkeypatch):
    swinging = [np.array([[x, 0.0, 0.0]]) for x in (0, 1, 0, 1, 0)]
    found = {  # by seed, of the problems that are left
        0: [None, swinging, swinging[:2], None],
        1: [None, swinging[:3], swinging],
        2: [None, None],
        3: [None, swinging],
    }

    class Planner:
        def plan_batch(self, problems, *, seed):
            paths = [None if x is None else np.concatenate(x) for x in found[seed]]
            assert len(problems.start) == len(paths)
            costs = dict.fromkeys(["sampling_checks", "search_checks", "edge_checks"], 0)
            times = {"planning_time_s": 0.0, "total_time_s": 0.0, "roadmaps": 1}
            return [make_plan(path, "none", 3, **costs, **times) for path in paths]

    monkeypatch.setattr(real_arm_parts, "_planner", lambda *of: Planner())
    problems = Problem(*np.zeros((2, 4, 3), np.float32), make_scene([], []))
    problems = problems._replace(scene=jax.tree.map(lambda x: np.stack([x] * 4), problems.scene))
    paths = find_paths(None, "guided", problems, 0.0, 0)
    assert [path and len(path) for path in paths] == [None, 3, 2, 5]
    paths = find_paths(None, "gnn_paper", problems, 0.0, 0)
    assert [path and len(path) for path in paths] == [None, 5, 2, None]


def test_motions_that_touch_are_not_suitable_and_paths_in_collision_are_not_timed(arm):
    robot, problems = load_robot(arm), problems_of()
    scenes = problems.scene._replace(centers=np.full_like(problems.scene.centers, 3.0))
    path = [[-1.0, 0, 0], [1.0, 0, 0]]
    conditions = Conditions(0.02, 0.2, ModelErrors())
    scenes.centers[2, 0] = [0.68, 0.15, 0.0]
    problems = problems._replace(scene=scenes)
    rows = carry_out(robot, problems, [path, None, path], conditions)
    assert [row["timed"] for row in rows] == [True, False, False]
    assert all(row["held"] for row in rows)
    assert "not certified" in rows[2]["reason"]
    assert rows[0]["suitable"]
    assert summarize(rows)["suitable_share"]["mean"] == pytest.approx(1 / 3)
    # A hundredth of the motors' torques does not lift the arm.
    weak = carry_out(robot, problems, [path, None, path], conditions._replace(reserve=0.99))
    assert not any(row["held"] or row["timed"] for row in weak)
    assert "to hold the arm at the start" in weak[0]["reason"]
    assert summarize(weak)["suitable_share"] is None


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
