"""Joints that turn more than once: all turns may be used, and one is drawn from."""

import jax
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.clearances import clearances
from gnnjax.planning.options import PlannerOptions
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import default_radius
from gnnjax.roadmap.stored import stored_roadmap
from gnnjax.scene.scene import make_scene
from tests.fine_scan import collides_anywhere


def written(folder, tiny_path, ranges):
    text, old = tiny_path.read_text(), ("-3 3", "-2.5 2.5", "-2 2")
    for before, after in zip(old, ranges, strict=True):
        assert f'range="{before}"' in text
        text = text.replace(f'range="{before}"', f'range="{after}"')
    folder.mkdir(exist_ok=True)
    path = folder / "tiny.xml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def wide(tmp_path_factory, tiny_path):
    folder = tmp_path_factory.mktemp("wide")
    return load_robot(written(folder, tiny_path, ("-6.2832 6.2832", "-2.5 2.5", "-6.2832 6.2832")))


@pytest.fixture(scope="module")
def narrow(tmp_path_factory, tiny_path):
    folder = tmp_path_factory.mktemp("narrow")
    ends = "-3.1415927 3.1415927"
    return load_robot(written(folder, tiny_path, (ends, "-2.5 2.5", ends)))


def problems_of(robot, lower, upper, num, seed=0):
    rng, drawn = np.random.default_rng(seed), []
    while len(drawn) < num:
        centers = rng.uniform(-0.8, 0.8, (5, 3))
        centers *= np.maximum(1, 0.5 / np.linalg.norm(centers, axis=1))[:, None]
        scene = make_scene(centers, rng.uniform(0.05, 0.2, (5, 3)))
        ends = rng.uniform(lower, upper, (2, 3)).astype(np.float32)
        if (clearances(robot, scene, ends) > 0).all():
            drawn.append(Problem(*ends, scene))
    return jax.tree.map(lambda *x: np.stack(x), *drawn)


@pytest.mark.parametrize(
    ("given", "first"),
    [
        ("-6.2832 6.2832", -np.pi),
        ("0 12.6", 0.0),
        ("-12.6 0", -2 * np.pi),
        ("-4 3", 3 - 2 * np.pi),
        ("-7 2", 2 - 2 * np.pi),
    ],
)
def test_the_turn_next_to_zero_is_drawn_from(tmp_path, tiny_path, given, first, caplog):
    robot = load_robot(written(tmp_path / "arm", tiny_path, (given, "-2.5 2.5", "-3.14 3.14")))
    np.testing.assert_allclose(robot.drawn_lower, [first, -2.5, -3.14], atol=1e-5)
    np.testing.assert_allclose(robot.drawn_upper, [first + 2 * np.pi, 2.5, 3.14], atol=1e-5)
    assert (robot.drawn_lower >= robot.joint_lower).all()
    assert (robot.drawn_upper <= robot.joint_upper).all()
    assert "within one turn of joints that turn by more, and around start and goal" in caplog.text
    assert caplog.text.rstrip().endswith("in any: a")


def test_a_slide_has_no_turns(tmp_path, tiny_path):
    path = written(tmp_path / "arm", tiny_path, ("-7 7", "-2.5 2.5", "-2 2"))
    path.write_text(path.read_text().replace('name="a" axis', 'name="a" type="slide" axis'))
    robot = load_robot(path)
    np.testing.assert_array_equal(robot.drawn_lower, robot.joint_lower)
    np.testing.assert_array_equal(robot.drawn_upper, robot.joint_upper)


def test_roadmaps_are_those_of_the_arm_that_turns_once(wide, narrow):
    assert default_radius(wide, 62) == pytest.approx(default_radius(narrow, 62), rel=1e-5)
    nodes, expected = (stored_roadmap(robot, 60, 0).nodes for robot in (wide, narrow))
    np.testing.assert_allclose(nodes, expected, atol=1e-5)


@pytest.mark.parametrize("planner", ["guided", "lazysp"])
def test_paths_cost_what_they_do_for_the_arm_that_turns_once(wide, narrow, planner, planner_once):
    options = PlannerOptions(planner=planner, num_nodes=60, max_roadmaps=2)
    problems = problems_of(narrow, narrow.joint_lower, narrow.joint_upper, 60)
    line = certify_edges(narrow, problems.scene, problems.start, problems.goal, np.arange(60))
    problems = jax.tree.map(lambda x: x[~line], problems)
    costs = []
    for robot in (wide, narrow):
        plans = planner_once(robot, options).plan_batch(problems)
        costs.append(np.array([plan.cost for plan in plans]))
    both = np.isfinite(costs).all(axis=0)
    assert both.sum() >= 12
    if planner == "lazysp":
        np.testing.assert_allclose(*costs, rtol=1e-4)
    else:  # which may turn further on its way
        assert costs[0][both].mean() < 1.03 * costs[1][both].mean()


@pytest.mark.parametrize("planner", ["guided", "lazysp"])
def test_ends_in_other_turns_are_reached_as_they_are(wide, planner, planner_once):
    options = PlannerOptions(planner=planner, num_nodes=60, max_roadmaps=2)
    problems = problems_of(wide, wide.joint_lower, wide.joint_upper, 12, seed=1)
    beyond = np.abs(np.concatenate([problems.start, problems.goal])).max(axis=1) > np.pi
    assert beyond.sum() > 12
    solved = 0
    for i, plan in enumerate(planner_once(wide, options).plan_batch(problems)):
        if plan.success:
            solved += 1
            np.testing.assert_array_equal(plan.path[0], problems.start[i])
            np.testing.assert_array_equal(plan.path[-1], problems.goal[i])
            scene = jax.tree.map(lambda x, i=i: x[i], problems.scene)
            assert not collides_anywhere(wide, scene, plan.path, step=0.01)
    assert solved >= (10 if planner == "guided" else 6)
