"""Planning a query end to end, and what bad input gets."""

import functools
import inspect
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from flax import nnx

from gnnjax import clock
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_path
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.collision.margins import proven_clearance
from gnnjax.errors import InputError
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.paper.strategy import gnn
from gnnjax.plan import PlanConfig
from gnnjax.plan import main as plan_once
from gnnjax.planning import load, motions
from gnnjax.planning import planner as planners
from gnnjax.planning.load import load_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.problems.problem import Problem
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.holding import attach_from_json
from gnnjax.scene.scene import make_scene
from gnnjax.scene.scene_file import scene_from_json
from gnnjax.training.weights import default_weights, load_network
from gnnjax.trajectory import moves
from gnnjax.trajectory.options import MotionOptions
from gnnjax.trajectory.timing import fastest
from gnnjax.trajectory.trajectory import find_motions, time_path
from tests.fine_scan import collides_anywhere, random_scene


@functools.cache
def load_once(path, method):
    return load_planner(path, method, num_nodes=60, max_roadmaps=2)


@pytest.mark.parametrize("method", ["lazysp", "distance", "prm", "oracle"])
def test_every_method_plans_certified_paths(tiny_path, method):
    robot, rng = load_robot(tiny_path), np.random.default_rng(1)
    planner = load_once(tiny_path, method)
    solved = 0
    for _ in range(6):
        scene = random_scene(rng)
        while True:
            start, goal = rng.uniform(robot.joint_lower, robot.joint_upper, (2, 3))
            if min(configuration_clearance(robot, scene, q) for q in (start, goal)) > 0:
                break
        plan = planner.plan(scene, start, goal)
        solved += plan.success
        if not plan.success:
            assert "no path in the 2 roadmaps" in plan.reason
            assert len(plan.path) == 0
            continue
        np.testing.assert_allclose(plan.path[[0, -1]], [start, goal], atol=1e-6)
        assert not collides_anywhere(robot, scene, plan.path, step=0.01)
        assert plan.certified
        assert plan.configuration_checks == plan.sampling_checks + plan.search_checks
        assert plan.sampling_checks >= 2 + 58
    assert solved >= 5


def test_compiled_code_is_kept_before_a_guide_compiles(tiny_path, monkeypatch):
    called = []
    monkeypatch.setattr(load, "cache_compilations", lambda: called.append("cache"))
    guide = load.field_guide
    monkeypatch.setattr(load, "field_guide", lambda r: called.append("guide") or guide(r))
    load_planner(tiny_path)
    assert called == ["cache", "guide"]


def test_the_same_seed_gives_the_same_plan(tiny_path):
    planner = load_once(tiny_path, "lazysp")
    scene = random_scene(np.random.default_rng(2))
    first, again = (
        planner.plan(scene, [0.5, 1, 0], [-2, -1, 1], seed=3)._replace(
            planning_time_s=0.0, total_time_s=0.0
        )
        for _ in range(2)
    )
    jax.tree.map(np.testing.assert_array_equal, first[:2] + first[2:], again[:2] + again[2:])


LIMITS = {"velocity": 1.0, "acceleration": [2.0, 3.0, 4.0]}


def test_plans_come_with_their_motions(tiny_path, monkeypatch):
    def slow(*given):
        seconds[0] += 1.5  # while it is traced
        return fastest(*given)

    def seeing(*given, **named):
        seen.append(given[-1])
        return find_motions(*given, **named)

    seen, seconds = [], [0.0]
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=lambda: seconds[0]))
    monkeypatch.setattr(moves, "fastest", slow)
    monkeypatch.setattr(motions, "find_motions", seeing)
    planner = load_planner(tiny_path, "lazysp", num_nodes=60, margin=0.02)
    scenes = [random_scene(np.random.default_rng(2)), make_scene([[0, 0, 0]], [[0.4, 0.4, 3]])]
    starts, goals = np.array([[0.5, 1, 0]] * 2, "f4"), np.array([[-2, -1, 1]] * 2, "f4")
    problems = Problem(starts, goals, stack_scenes(scenes))
    moves._compiled.cache_clear()
    plans = planner.plan_batch(problems, trajectory=MotionOptions(**LIMITS))
    moves._compiled.cache_clear()
    assert [plan.success for plan in plans] == [True, False]
    assert plans[1].trajectory is None
    found = plans[0].trajectory
    assert found is not None
    assert found.success
    assert seconds[0] >= 1.5
    assert found.time_s == 0.0  # without what it took to compile
    monkeypatch.undo()
    assert seen == [0.02]  # the margin
    other = time_path(planner.robot, scenes[0], plans[0].path, margin=0.02, **LIMITS)
    assert other.duration == found.duration
    alone = planner.plan(scenes[0], starts[0], goals[0], trajectory=MotionOptions(**LIMITS))
    assert alone.trajectory is not None
    assert alone.trajectory.duration == found.duration
    assert planner.plan(scenes[0], starts[0], goals[0]).trajectory is None


def test_limits_of_motions_are_checked_before_planning(tiny_path, monkeypatch):
    planner = load_planner(load_robot(tiny_path), "lazysp", num_nodes=60)
    monkeypatch.setattr(planners.SampledPlanner, "_plan_batch", lambda *_: pytest.fail("planned"))
    scene = make_scene([], [])
    with pytest.raises(InputError, match="tiny has no velocity limits; give velocity="):
        planner.plan(scene, [0.5, 1, 0], [-2, -1, 1], trajectory=True)
    wanted = inspect.unwrap(motions.motion_options)
    with pytest.raises(InputError, match=r"trajectory is {'velocity': 1.0}; give True or MotionO"):
        wanted(planner.robot, {"velocity": 1.0})
    assert wanted(planner.robot, np.False_) is None
    with pytest.raises(InputError, match="no option 'speed' of a motion; there are"):
        time_path(planner.robot, scene, [[0, 0, 0]], speed=1.0)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ([0.0, 0.0], r"start has shape \(2,\); tiny needs 3 joint values"),
        ([0.0, float("nan"), 0.0], "start has nan for joint b; it must lie between"),
        ([9.0, 0.0, 0.0], "start has 9 for joint a; it must lie between -3 and 3"),
        ([1e300, 0.0, 0.0], "start has inf for joint a"),
        (["a", 0.0, 0.0], "is not a list of numbers"),
        ([0.0, 0.0, 0.0], "start .* is in collision"),
    ],
)
def test_a_bad_start_is_refused_with_its_value(tiny_path, start, message):
    scene = make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    with pytest.raises(InputError, match=message):
        load_once(tiny_path, "lazysp").plan(scene, start, [2.0, 0.0, 0.0])


def test_a_box_in_the_base_is_refused(tiny_path):
    scene = make_scene([[0.0, 0.0, 0.1]], [[0.05, 0.05, 0.05]])
    with pytest.raises(InputError, match=r"box 0 of the scene reaches .* mm into the base"):
        load_once(tiny_path, "lazysp").plan(scene, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robot": "pr2"}, "no robot 'pr2' in assets/; there are"),
        ({"robot": "missing.xml"}, "no MJCF file at 'missing.xml'"),
        ({"robot": "kuka_iiwa14", "planner": "magic"}, "no planner 'magic'; there are"),
        ({"robot": "kuka_iiwa14", "num_nodes": 1}, "num_nodes is 1"),
        ({"robot": "kuka_iiwa14", "max_roadmaps": 0}, "max_roadmaps is 0"),
        ({"robot": "kuka_iiwa14", "nodes": 3}, "no option 'nodes' of a planner; there are"),
        ({"robot": "kuka_iiwa14", "planner": "greedy"}, "'greedy' has no scorer; give it one"),
        ({"robot": "kuka_iiwa14", "planner": "gnn", "weights": "motion"}, "takes a Guidance"),
        ({"robot": "kuka_iiwa14", "weights": "kuka_iiwa14"}, "is a GuidanceNetwork, for 'gnn'"),
    ],
)
def test_bad_planner_arguments_name_the_choices(arguments, message):
    with pytest.raises(InputError, match=message):
        load_planner(**arguments)


@pytest.fixture
def run_plan(tiny_path, tmp_path, monkeypatch, run_as_command):
    def run(scene, start, goal):
        monkeypatch.chdir(tmp_path)
        Path("scene.json").write_text(json.dumps(scene))
        words = ["--robot", tiny_path, "--scene", "scene.json", "--start", *start, "--goal", *goal]
        words += ["--num-nodes", "40", "--max-roadmaps", "2", "--image", "plan.png"]
        return run_as_command("gnnjax.plan", *words)

    return run


def test_the_command_plans_and_draws(tiny_path, tmp_path, run_plan):
    scene = {"boxes": [{"center": [0.6, 0, 0], "half_extents": [0.1, 0.1, 0.1]}]}
    status, printed, said = run_plan(scene, ["-1.5", "0", "0"], ["1.5", "0", "0"])
    assert status == 0, said
    with np.load(tmp_path / "path.npz") as file:
        assert file["path"].shape[1] == 3
        assert file["certified"]
        robot, boxes = load_robot(tiny_path), scene_from_json(tmp_path / "scene.json")
        assert file["clearance"] == proven_clearance(robot, boxes, file["path"])
        line = f"proven to keep {1e3 * file['clearance']:.0f} mm from all obstacles"
        assert line in printed
    assert (tmp_path / "plan.png").stat().st_size > 10_000


def test_the_command_returns_1_where_there_is_no_path(tiny_path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # A wall in front of the arm, whose first joint cannot turn the other way round.
    scene = {"boxes": [{"center": [0.6, 0, 0], "half_extents": [0.47, 0.02, 1.0]}]}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    ends = {"start": (-1.5, 0.0, 0.0), "goal": (1.5, 0.0, 0.0)}
    options = {"planner": "lazysp", "num_nodes": 60, "max_roadmaps": 2}
    config = PlanConfig(scene=Path("scene.json"), robot=str(tiny_path), **ends, **options)
    assert plan_once(config) == 1
    assert "no path in the 2 roadmaps tried (60 nodes" in capsys.readouterr().out
    assert not config.out.exists()


def test_the_command_says_in_one_line_what_is_wrong(tmp_path, run_plan):
    scene = {"boxes": [{"center": [0.6, 0, 0], "half_extents": [0.1, -0.1, 0.1]}]}
    status, _, said = run_plan(scene, ["-1.5", "0", "0"], ["1.5", "0", "0"])
    assert status == 2
    assert said.startswith("error: box 0 of 'scene.json' has half_extents")
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "path.npz").exists()


def test_the_command_plans_for_what_is_held(tiny_path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene = {"boxes": [{"center": [0.9, 0, 0.6], "half_extents": [0.3, 0.1, 0.1]}]}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    ball = {"center": [0.2, 0, 0.6], "radius": 0.05}
    (tmp_path / "ball.json").write_text(json.dumps({"body": "lower", "spheres": [ball]}))
    ends = {"start": (-1.0, 0.0, 0.0), "goal": (1.0, 0.0, 0.0)}
    options = {"planner": "lazysp", "num_nodes": 60}
    held = PlanConfig(
        scene=Path("scene.json"), robot=str(tiny_path), attach=Path("ball.json"), **ends, **options
    )
    assert plan_once(held) == 0
    robots = [load_robot(tiny_path)]
    robots.append(attach_from_json(robots[0], "ball.json"))
    scene = scene_from_json("scene.json")
    found = np.load("path.npz")
    paths = [list(ends.values()), found["path"]]
    proven = [[certify_path(robot, scene, path) for path in paths] for robot in robots]
    assert proven == [[True, True], [False, True]]
    assert "tiny_holding_" in str(found["robot"])
    (tmp_path / "ball.json").write_text('{"boxes": []}')
    with pytest.raises(InputError, match=r"file to attach 'ball\.json' names no body"):
        plan_once(held)


def test_the_clearance_of_a_plan_is_at_least_the_margin_and_that_of_none_is_refused(tiny_path):
    planner = load_planner(tiny_path, "lazysp", num_nodes=60, max_roadmaps=2, margin=0.04)
    scene = make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    plan = planner.plan(scene, [-1.5, 0, 0], [1.5, 0, 0])
    assert plan.success
    assert planner.clearance(scene, plan) >= 0.039
    with pytest.raises(InputError, match="there is no path to measure: none"):
        planner.clearance(scene, plan._replace(success=False, reason="none"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"out": "."}, r"'\.' is a folder; name a file"),
        ({"out": "scene.json/path.npz"}, r"'scene.json' is a file; name a folder"),
        ({"out": "path.csv"}, r"path file 'path.csv' has the ending '.csv'; give .npz"),
        ({"image": "plan.xyz"}, r"picture 'plan.xyz' has no known ending; there are \["),
        ({"image": "plan"}, "picture 'plan' has no known ending"),
        ({"out": "scene.json"}, "'scene.json' would be written, and is also read from; name anot"),
        ({"image": "p.png", "out": "p.png"}, "'p.png' would be written, and is also written other"),
        ({"planner": "magic"}, "no planner 'magic'; there are"),
        ({"scene": "missing.json"}, "no scene file 'missing.json'"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_what_can_be_refused_is_refused_before_planning(
    tiny_path, tmp_path, monkeypatch, change, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.json").write_text('{"boxes": []}')
    settings = {"scene": "scene.json", "robot": str(tiny_path), "planner": "lazysp", **change}
    paths = {n: Path(v) for n, v in settings.items() if n in ("scene", "out", "image")}
    with pytest.raises(InputError, match=message):
        plan_once(PlanConfig(start=(0.0, 0.0, 0.0), goal=(1.0, 0.0, 0.0), **{**settings, **paths}))
    assert [path.name for path in tmp_path.iterdir()] == ["scene.json"]


def test_files_that_a_scene_names_are_not_written_over(tiny_path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rooms").mkdir()
    points = tmp_path / "rooms" / "camera.npz"
    np.savez(points, points=np.array([[0.0, 0.0, 2.5]]))
    before = points.read_bytes()
    scene = {"clouds": [{"points": "camera.npz", "radius": 0.01}]}
    (tmp_path / "rooms" / "scene.json").write_text(json.dumps(scene))
    for ends in ({"out": Path("rooms/camera.npz")}, {"out": points}):
        with pytest.raises(InputError, match="would be written, and is also read from"):
            plan_once(
                PlanConfig(
                    scene=Path("rooms/scene.json"),
                    start=(0.0, 0.0, 0.0),
                    goal=(1.0, 0.0, 0.0),
                    robot=str(tiny_path),
                    **ends,
                )
            )
    assert points.read_bytes() == before


def test_an_arm_of_a_box_is_planned_for_and_its_name_is_said(tmp_path):
    path = tmp_path / "brick.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint range="-90 90" limited="true"/>'
        '<geom name="brick" type="box" size=".1 .1 .1"/></body></worldbody></mujoco>'
    )
    planner = load_planner(path, "lazysp", num_nodes=20)
    assert planner.plan(make_scene([], []), [0.0], [1.0]).success
    for checker in ("fused", "mjx"):
        planner = load_planner(path, "lazysp", checker=checker, num_nodes=20)
        with pytest.raises(InputError, match=r"start .* is in collision: brick and box 0 overlap"):
            planner.plan(make_scene([[0.2, 0, 0]], [[0.15] * 3]), [0.0], [1.0])


def test_an_arm_of_three_joints_plans_with_the_network_for_seven(tiny_path):
    planner = load_planner(tiny_path, "gnn", num_nodes=60, max_roadmaps=2)
    assert planner.robot.num_dof == 3
    assert load_network(default_weights("tiny")).num_dof == 7
    scene = make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    plan = planner.plan(scene, [-1.5, 0, 0], [1.5, 0, 0])
    assert plan.success
    assert plan.path.shape[1] == 3
    assert certify_path(planner.robot, scene, plan.path)


def test_a_scene_that_is_none_is_refused_before_anything_is_compiled(tiny_path):
    scene = make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    planner = load_planner(tiny_path, "lazysp", num_nodes=60)
    with pytest.raises(InputError, match="existing obstacle 0 of the scene has centers"):
        planner.plan(scene._replace(centers=scene.centers * np.nan), [1, 0, 0], [2, 0, 0])
    compiled = planner._compiled(True)
    assert not sum(function._cache_size() for function in compiled)


def test_a_network_for_fewer_joints_is_refused(tiny_path):
    network = nnx.eval_shape(lambda: GuidanceNetwork(num_dof=2, channels=8, rngs=nnx.Rngs(0)))
    with pytest.raises(InputError, match="made for up to 2 joints, tiny has 3; train one with"):
        gnn(load_robot(tiny_path), network, PlannerOptions(planner="gnn"))
