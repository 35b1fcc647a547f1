"""What a viewer edits and draws, without a browser."""

import dataclasses
import shlex
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tyro

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.plan import PlanConfig
from gnnjax.planning.load import load_planner
from gnnjax.pose.goal import PoseGoal
from gnnjax.scene.allowed import allow_contacts
from gnnjax.scene.scene import make_scene, scene_from_shapes
from gnnjax.scene.scene_file import scene_from_json
from gnnjax.scene.shapes import KINDS, box, capsule, cylinder, half_space, kind_of, sphere
from gnnjax.trajectory.options import MotionOptions
from gnnjax.view import ViewConfig
from gnnjax.viewer.answers import Answer, Query, make_reach, make_solver, state_at, without_path
from gnnjax.viewer.frames import Frames
from gnnjax.viewer.meshes import arm_pieces, geom_mesh, ghost_pieces, obstacle_mesh, shown_geoms
from gnnjax.viewer.prices import make_pricer
from gnnjax.viewer.saving import query_text, scene_text
from gnnjax.viewer.session import NEW, Session, placed, sizes_of
from gnnjax.viewer.worker import Worker

START, GOAL = np.float32([-1.0, 0.2, 0.1]), np.float32([1.0, 0.2, -0.1])
TURNED = [0.8, 0.6, 0.0, 0.0]
SHAPES = [
    box([0.6, 0.4, 0], [0.1, 0.2, 0.3], TURNED),
    sphere([0, 0.8, 0], 0.1),
    capsule([0, -0.8, 0], 0.05, 0.1, TURNED),
    cylinder([-0.8, 0, 0], 0.1, 0.15, TURNED),
    half_space([0, 0.1, -1.5], [0, 0.6, 0.8]),
]
SCENE = scene_from_shapes(SHAPES)
TIMEOUT = 60.0


def volume(mesh):
    """Of what triangles enclose; positive where their normals point out of it, m^3."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6


def session_of(robot, scene=SCENE, solve=None, reach=None, **how):
    def nothing(query):
        return Answer(query, None, "nothing", np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))

    query = Query(scene, START, GOAL)
    return Session(robot, query, solve or nothing, reach or nothing, pause_s=0.0, **how)


@pytest.fixture
def session(tiny):
    made = session_of(tiny)
    yield made
    made.worker.close()


def test_triangles_of_obstacles_enclose_what_these_do():
    sizes = {kind: sizes_of(shape) for kind, shape in zip(KINDS, SHAPES, strict=True)}
    ball = 4 / 3 * np.pi
    expected = {
        "box": 8 * 0.1 * 0.2 * 0.3,
        "sphere": ball * 0.1**3,
        "capsule": ball * 0.05**3 + np.pi * 0.05**2 * 0.2,
        "cylinder": np.pi * 0.1**2 * 0.3,
    }
    for kind, size in expected.items():
        mesh = obstacle_mesh(kind, sizes[kind].half_extents, sizes[kind].radii)
        assert volume(mesh) == pytest.approx(size, rel=0.03)
        assert np.abs(mesh.vertices[:, 2]).max() == pytest.approx(
            sizes[kind].half_extents[2] + sizes[kind].radii[1]
        )
    plane = sizes["half_space"]
    corners = obstacle_mesh("half_space", plane.half_extents, plane.radii).vertices
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, plane.quats)
    corners = corners @ turn.reshape(3, 3).T + plane.centers
    np.testing.assert_allclose((corners - [0, 0.1, -1.5]) @ [0, 0.6, 0.8], 0, atol=1e-9)


def test_triangles_of_geoms_lie_on_them_where_mujoco_has_them(tmp_path):
    (tmp_path / "arm.xml").write_text(
        """<mujoco><compiler autolimits="true"/><worldbody><body><joint range="-1 1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0 0.3 0.2"/>
        <geom type="ellipsoid" size="0.1 0.05 0.2" pos="0.1 0 0" euler="20 0 40"/>
        <geom type="box" size="0.1 0.05 0.2" pos="0 0.1 0" euler="20 30 0"/>
        <geom type="cylinder" size="0.1 0.2" pos="0 0 0.1" euler="0 30 10"/>
        </body></worldbody></mujoco>"""
    )
    model = mujoco.MjSpec.from_file(str(tmp_path / "arm.xml")).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    volumes = (
        np.pi * 0.05**2 * (np.sqrt(0.13) + 4 / 3 * 0.05),
        4 / 3 * np.pi * 0.1 * 0.05 * 0.2,
        8 * 0.1 * 0.05 * 0.2,
        np.pi * 0.1**2 * 0.4,
    )
    for g, size in enumerate(volumes):
        mesh = geom_mesh(model, g)
        assert volume(mesh) == pytest.approx(size, rel=0.03)
        middle, kind = data.geom_xpos[g], int(model.geom_type[g])
        for ray in mesh.vertices - middle + 1e-5:  # along an axis MuJoCo misses the near side
            # From afar towards the middle, the geom begins at the corner of a triangle.
            away = mujoco.mju_rayGeom(
                middle, data.geom_xmat[g], model.geom_size[g], middle + 3 * ray, -ray, kind
            )
            assert away == pytest.approx(2, abs=1e-3)


@pytest.mark.parametrize("name", ["kuka_iiwa14", "franka_panda", "kinova_gen3"])
def test_of_arms_all_that_moves_is_drawn(name):
    robot = load_robot(name)
    model = robot.mj_model
    moved = {part.body + 1 for part in robot.parts if model.body_weldid[part.body + 1]}
    assert moved == {piece.body for piece in ghost_pieces(robot, (1.0, 0.0, 0.0, 0.5))}
    assert moved <= {piece.body for piece in arm_pieces(robot)}
    # What has clothes of its own is not drawn as its hulls.
    assert not set(shown_geoms(robot)) & set(robot.part_geom_ids.tolist())


def test_what_an_arm_holds_is_drawn_and_so_is_an_arm_without_clothes(tiny):
    holding = tiny.attach("lower", [box([0.2, 0, 0], [0.02, 0.02, 0.1])])
    assert shown_geoms(tiny) == list(range(4))
    assert len(shown_geoms(holding)) == 5
    hidden = holding.mj_spec.copy()
    for geom in hidden.geoms:
        geom.group = 3
    bare = dataclasses.replace(holding, mj_model=hidden.compile())
    assert shown_geoms(bare) == shown_geoms(holding)


def test_bodies_and_hand_are_where_mujoco_has_them(tiny):
    data = mujoco.MjData(tiny.mj_model)
    data.qpos[:] = [0.3, -0.5, 0.7]
    mujoco.mj_forward(tiny.mj_model, data)
    frames = Frames(tiny)
    positions, quats = frames.bodies(np.array([0.3, -0.5, 0.7]))
    np.testing.assert_array_equal(positions, data.xpos)
    np.testing.assert_array_equal(quats, data.xquat)
    position, quat = frames.tip(np.array([0.3, -0.5, 0.7]))
    np.testing.assert_allclose(position, data.xpos[-1])
    np.testing.assert_allclose(quat, data.xquat[-1])
    kuka = load_robot("kuka_iiwa14")
    data = mujoco.MjData(kuka.mj_model)
    data.qpos[:] = kuka.home
    mujoco.mj_kinematics(kuka.mj_model, data)
    tool = kuka.mj_model.site("tool").id
    position, quat = Frames(kuka).tip(kuka.home)
    expected = np.zeros(4)
    mujoco.mju_mat2Quat(expected, data.site_xmat[tool])
    np.testing.assert_allclose(position, data.site_xpos[tool], atol=1e-12)
    assert abs(quat @ expected) == pytest.approx(1)
    np.testing.assert_array_equal(Frames(kuka).tips(kuka.home[None])[0], position)


def test_a_session_has_all_obstacles_of_its_scene(session):
    assert list(session.names().values()) == [f"{kind} 0" for kind in KINDS]
    for shape, (number, kept) in zip(SHAPES, session.shapes.items(), strict=True):
        position, quat = placed(kept)
        known = placed(shape)
        if shape.kind == "half_space":  # any point of the plane describes it
            assert (position - known[0]) @ [0, 0.6, 0.8] == pytest.approx(0, abs=1e-5)
        else:
            np.testing.assert_allclose(position, known[0], atol=1e-5, err_msg=str(number))
        np.testing.assert_allclose(np.abs(quat @ known[1]), 1, atol=1e-6)
    scene = session.query.scene
    for kept, given in zip(scene[:5], SCENE[:5], strict=True):
        np.testing.assert_allclose(kept, given, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_obstacles_are_added_moved_and_removed(session, kind):
    number = session.add(NEW[kind])
    name = session.names()[number]
    assert name == f"{kind} 1"
    turn, place = np.array([0.6, 0.0, 0.8, 0.0]), np.array([0.1, 0.2, 0.3])
    session.move(number, place, turn)
    position, quat = placed(session.shapes[number])
    np.testing.assert_allclose(position, place)
    matrix, wanted = np.zeros(9), np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    mujoco.mju_quat2Mat(wanted, turn)
    if kind != "sphere":
        np.testing.assert_allclose(matrix[2::3], wanted[2::3], atol=1e-9)
    scene = session.query.scene
    row = session.rows.index(number)
    assert KINDS[kind_of(scene.half_extents, scene.radii)[row]] == kind
    if kind != "half_space":
        np.testing.assert_allclose(scene.centers[row], place, atol=1e-6)
    session.remove(number)
    assert number not in session.shapes
    for kept, given in zip(session.query.scene[:5], SCENE[:5], strict=True):
        np.testing.assert_allclose(kept, given, atol=1e-5)
    session.move(number, place, turn)  # a hand that still drags what is gone
    assert number not in session.shapes


def test_what_is_no_obstacle_changes_nothing(session):
    before = session.query
    with pytest.raises(InputError, match=r"box 0 of the scene has half_extents .*positive"):
        session.resize(0, half_extents=np.array([0.1, 0.0, 0.1]))
    for _ in range(123):
        session.add(NEW["sphere"])
    with pytest.raises(InputError, match="at most 128 are supported"):
        session.add(NEW["sphere"])
    assert len(session.shapes) == 128
    assert before.scene is not session.query.scene
    sizes = session.shapes[0].values["half_extents"]
    np.testing.assert_allclose(sizes, [0.1, 0.2, 0.3], atol=1e-6)
    session.resize(0, half_extents=np.array([0.1, 0.1, 0.1]))
    np.testing.assert_allclose(session.query.scene.half_extents[0], 0.1)


def test_contacts_that_are_meant_stay_with_their_obstacle(tiny):
    scene = scene_from_shapes([sphere([0.5, 0, 0], 0.1), sphere([0.9, 0, 0], 0.1)])
    session = session_of(tiny, allow_contacts(tiny, scene, [("lower", "sphere 1")]))
    session.add(NEW["box"])  # which comes first in the scene
    session.remove(0)
    names = {number: name for number, name in session.names().items()}
    assert names == {2: "box 0", 1: "sphere 0"}
    allowed = session.query.scene.allowed
    assert np.argwhere(allowed.pairs).tolist() == [[1, 2]]
    session.worker.close()


def test_of_edits_while_something_is_planned_the_latest_wins(tiny):
    begun, go_on, asked = threading.Event(), threading.Event(), []

    def solve(query):
        asked.append(query)
        begun.set()
        assert go_on.wait(TIMEOUT)
        return Answer(query, None, "", np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))

    shown = []
    session = session_of(tiny, solve=solve, changed=lambda: shown.append(session.answer))
    session.plan()
    assert begun.wait(TIMEOUT)
    for value in (0.1, 0.2, 0.3):
        session.set_end("goal", np.array([value, 0, 0]))
    assert session.answer is None
    assert not session.is_current
    go_on.set()
    assert session.worker.wait(TIMEOUT)
    assert [query.goal[0] for query in asked] == [GOAL[0], np.float32(0.3)]
    assert session.is_current
    # The answer to the first query was never shown.
    assert [a.query.goal[0] for a in shown if a is not None] == [np.float32(0.3)]
    session.worker.close()


def test_a_dragged_hand_waits_for_the_planner_and_takes_the_last_pose(tiny):
    reached = []

    def reach(scene, near, position, quat):
        reached.append(position[0])
        if position[0] > 1:
            raise InputError("out of reach")
        return near + np.float32(0.01)

    release = threading.Event()
    session = session_of(tiny, reach=reach)
    session.worker.ask("plan", lambda: release.wait(TIMEOUT))
    for x in (0.1, 0.2, 0.3):
        session.drag_end("start", np.array([x, 0, 0]), np.array([1.0, 0, 0, 0]))
    release.set()
    assert session.worker.wait(TIMEOUT)
    assert reached[-1] == 0.3
    assert len(reached) <= 2
    np.testing.assert_allclose(session.query.start, START + 0.01 * len(reached), atol=1e-6)
    session.drag_end("start", np.array([2.0, 0, 0]), np.array([1.0, 0, 0, 0]))
    assert session.worker.wait(TIMEOUT)
    assert session.message == "out of reach"
    session.set_end("goal", GOAL)
    assert session.message == ""
    session.worker.close()


def test_a_planner_that_fails_is_told_and_asked_again(tiny, capsys):
    def solve(query):
        if query.goal[0] == 0:
            raise ZeroDivisionError("no way")
        return without_path(query, None, "found")

    session = session_of(tiny, solve=solve)
    session.set_end("goal", np.zeros(3))
    assert session.worker.wait(TIMEOUT)
    assert session.is_current
    assert session.answer.text == "**no path**: planning failed: ZeroDivisionError('no way')"
    assert "no way" in session.message
    session.set_end("goal", GOAL)
    assert session.worker.wait(TIMEOUT)
    assert session.answer.text == "**no path**: found"
    session.worker.close()
    assert "Traceback" in capsys.readouterr().err


def test_a_worker_goes_on_after_what_fails(capsys):
    failed, done = [], []
    worker = Worker(failed.append)
    worker.ask("a", lambda: 1 // 0)
    assert worker.wait(TIMEOUT)
    worker.ask("a", lambda: done.append("replaced"), pause_s=30.0)
    worker.ask("a", lambda: done.append("a"))
    worker.ask("b", lambda: done.append("b"), pause_s=0.01)
    assert worker.wait(TIMEOUT)
    worker.close()
    assert done == ["a", "b"]
    assert isinstance(failed[0], ZeroDivisionError)
    assert "ZeroDivisionError" in capsys.readouterr().err


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
