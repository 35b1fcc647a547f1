"""What a viewer is told: plans, motions, prices of the guide, and files."""

import shlex
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tyro

from gnnjax.errors import InputError
from gnnjax.plan import PlanConfig
from gnnjax.planning.load import load_planner
from gnnjax.pose.goal import PoseGoal
from gnnjax.scene.scene import make_scene
from gnnjax.scene.scene_file import scene_from_json
from gnnjax.trajectory.options import MotionOptions
from gnnjax.view import ViewConfig
from gnnjax.viewer.answers import Query, make_reach, make_solver, state_at
from gnnjax.viewer.frames import Frames
from gnnjax.viewer.prices import make_pricer
from gnnjax.viewer.saving import query_text, scene_text
from tests.viewed import GOAL, START, TIMEOUT, session_of


@pytest.fixture(scope="module")
def planner(tiny_path):
    return load_planner(tiny_path, max_roadmaps=1)


def test_what_is_saved_is_read_again_and_planned_the_same(tiny, planner, tmp_path):
    options = ViewConfig(robot="tiny.xml", margin=0.0, max_roadmaps=1, velocity=(1.5,))
    solve = make_solver(planner, MotionOptions(), 0)
    session = session_of(tiny, make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]]), solve)
    session.set_end("start", np.array([-1.5, 0, -1e-5]))
    session.move(0, np.array([0.6, 0.01, 0.02]), np.array([1.0, 0.0, 0.0, 0.0]))
    assert session.worker.wait(TIMEOUT)
    plan = session.answer.plan
    assert plan.success
    (tmp_path / "scene.json").write_text(scene_text(session.query.scene))
    chosen = {"joints": ("a", "b"), "hold": (("c", -0.5), ("d", 0.1)), "attach": None}
    words = shlex.split(query_text(session, options, robot="tiny.xml", **chosen))
    config = tyro.cli(PlanConfig, args=words)
    assert (config.joints, config.hold) == (chosen["joints"], chosen["hold"])
    assert (config.scene, config.robot) == (Path("scene.json"), "tiny.xml")
    assert (config.max_roadmaps, config.velocity) == (1, (1.5,))
    assert config.trajectory == Path("motion.npz")  # without which the command takes no limits
    ends = np.array(config.start), np.array(config.goal)
    again = planner.plan(scene_from_json(tmp_path / "scene.json"), *ends)
    np.testing.assert_array_equal(again.path, plan.path)
    session.worker.close()


def test_answers_tell_what_was_found_and_move_in_time(tiny, planner):
    free = Query(make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]]), START, GOAL)
    untimed = make_solver(planner, MotionOptions(), 0)(free)
    assert f"cost {untimed.plan.cost:.3f} rad" in untimed.text
    assert "certified free" in untimed.text
    assert "no motion in time" in untimed.text
    assert untimed.times[-1] == pytest.approx(untimed.plan.cost)
    np.testing.assert_array_equal(state_at(untimed, 0.0), untimed.path[0])
    limits = MotionOptions(velocity=1.5, acceleration=5.0)
    timed = make_solver(planner, limits, 0)(free)
    motion = timed.plan.trajectory
    assert f"motion of {motion.duration:.2f} s, certified free" in timed.text
    assert timed.times[-1] == pytest.approx(motion.duration)
    np.testing.assert_allclose(state_at(timed, motion.duration), GOAL, atol=1e-5)
    with pytest.raises(InputError, match="acceleration"):
        make_solver(planner, MotionOptions(velocity=1.5, acceleration=-1.0), 0)


def test_a_start_in_collision_is_told_as_the_planner_does(tiny, planner):
    solve = make_solver(planner, MotionOptions(), 0)
    blocked = Query(make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]]), np.zeros(3), GOAL)
    answer = solve(blocked)
    assert answer.plan is None
    assert "start [0.0, 0.0, 0.0] is in collision" in answer.text
    assert "box 0 overlap by" in answer.text
    assert not len(answer.path)


def test_prices_are_the_guides_along_what_the_hand_does(tiny, planner):
    frames = Frames(tiny)
    price = make_pricer(planner, frames, 0)
    query = Query(make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]]), START, GOAL)
    found = price(query)
    ends = np.stack([found.lines[:, 0], found.lines[:, -1]]).reshape(-1, 3)
    gaps = np.linalg.norm(ends[:, None] - found.nodes, axis=-1).min(axis=1)
    assert gaps.max() < 1e-6
    # The first edge is that from start to goal, which goes through the box.
    np.testing.assert_allclose(found.lines[0, 0], frames.tip(START)[0], atol=1e-6)
    guide = planner.strategy.guide
    scene = jax.tree.map(jnp.asarray, query.scene)
    motions = guide.prices(guide.weights, guide.read(guide.weights, scene)).motions
    expected = motions(jnp.asarray(START)[None], jnp.asarray(GOAL)[None], 16)[0]
    assert found.prices[0] == pytest.approx(float(expected), rel=1e-4)
    assert found.prices[0] > 3
    empty = price(query._replace(scene=make_scene([], [])))
    assert empty.prices.max() < 1e-3
    walks = load_planner(tiny.path, "lazysp", num_nodes=60)
    message = "anew for each query with planner 'lazysp'; use 'guided' to see its prices"
    with pytest.raises(InputError, match=message):
        make_pricer(walks, frames, 0)
    drawn = load_planner(tiny.path, num_nodes=60, sampled=True)
    message = "anew for each query with sampled=True; leave it out to see its prices"
    with pytest.raises(InputError, match=message):
        make_pricer(drawn, frames, 0)


def test_a_hand_is_brought_to_a_pose_or_it_is_said_what_is_in_the_way(tiny):
    frames, goal = Frames(tiny), PoseGoal((0, 0, 0), (1, 0, 0, 0), ("rx", "ry", "rz"))
    reach = make_reach(tiny, goal._replace(tolerance=(1e-3, 1e-3)), 0.0)
    wanted = frames.tip(np.array([0.7, 0.3, 0.2]))
    q = reach(make_scene([], []), START, *wanted)
    np.testing.assert_allclose(frames.tip(q)[0], wanted[0], atol=1.1e-3)
    with pytest.raises(InputError, match="does not reach the pose"):
        reach(make_scene([], []), START, np.array([3.0, 0, 0]), wanted[1])
