"""What a viewer edits, without a browser."""

import threading

import mujoco
import numpy as np
import pytest

from gnnjax.errors import InputError
from gnnjax.scene.allowed import allow_contacts
from gnnjax.scene.scene import scene_from_shapes
from gnnjax.scene.shapes import KINDS, kind_of, sphere
from gnnjax.viewer.answers import Answer, without_path
from gnnjax.viewer.session import NEW, placed
from gnnjax.viewer.worker import Worker
from tests.viewed import GOAL, SCENE, SHAPES, START, TIMEOUT, session_of


@pytest.fixture
def session(tiny):
    made = session_of(tiny)
    yield made
    made.worker.close()


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
