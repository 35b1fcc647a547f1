"""The viewer's page: what is sent to browsers, and a browser that shows it."""

import contextlib
import itertools
import shutil
import socket
import sys
import threading
import time

import mujoco
import numpy as np
import pytest

from gnnjax.errors import InputError, run_command
from gnnjax.scene.cloud import point_cloud
from gnnjax.scene.scene import scene_from_shapes
from gnnjax.scene.scene_file import scene_from_json, scene_to_json
from gnnjax.view import ViewConfig, main, open_page
from gnnjax.viewer.answers import state_at
from gnnjax.viewer.frames import Frames
from tests.viewed import GOAL, SHAPES, START, TIMEOUT

pytest.importorskip("viser", reason="the view extra is not installed")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
_SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
_SOFTWARE += ["--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@pytest.fixture(scope="module")
def config(tiny_path, tmp_path_factory):
    file = tmp_path_factory.mktemp("scenes") / "scene.json"
    cloud = point_cloud(np.array([[0.0, 0.9, 0.4], [0.1, 0.9, 0.4]]))
    scene_to_json(scene_from_shapes(SHAPES, clouds=[cloud]), file)
    ends = {"start": tuple(START.tolist()), "goal": tuple(GOAL.tolist())}
    limits = {"velocity": (1.5,), "acceleration": (5.0,), "free": ("rx", "ry", "rz")}
    return ViewConfig(robot=str(tiny_path), scene=file, port=0, max_roadmaps=1, **ends, **limits)


@pytest.fixture(scope="module")
def page(config):
    with contextlib.closing(open_page(config)) as made:
        assert made.session.worker.wait(TIMEOUT)
        yield made


def assert_placed(drawn, robot, q):
    """That all bodies of a drawn arm are where MuJoCo has them."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_forward(robot.mj_model, data)
    assert drawn.bodies
    for body, handle in drawn.bodies.items():
        np.testing.assert_allclose(handle.position, data.xpos[body], atol=1e-6)
        np.testing.assert_allclose(handle.wxyz, data.xquat[body], atol=1e-6)


def test_bodies_are_sent_where_mujoco_has_them(page):
    robot, stage, player = page.session.robot, page.panel.stage, page.panel.player
    assert_placed(stage.ghosts["start"], robot, START)
    assert_placed(stage.ghosts["goal"], robot, GOAL)
    assert_placed(stage.arm, robot, START)
    player.time.value = 0.5 * player.time.max
    assert_placed(stage.arm, robot, state_at(page.session.answer, 0.5 * player.time.max))
    assert not np.allclose(player.time.value, 0)


def test_all_obstacles_are_sent_where_they_are(page):
    scene = page.session.query.scene
    stage = page.panel.stage
    assert len(stage.obstacles) == len(SHAPES)
    for number, (_, handle) in stage.obstacles.items():
        row = page.session.rows.index(number)
        np.testing.assert_allclose(handle.position, scene.centers[row], atol=1e-6)
        np.testing.assert_allclose(handle.wxyz, scene.quats[row], atol=1e-6)
    assert len(stage.cloud.points) == int(scene.cloud.num) == 2


def test_while_something_is_planned_the_last_path_is_grey_and_no_arm_is_shown(page):
    panel, session = page.panel, page.session
    assert panel.stage.arm.root.visible
    shown = [line.colors.copy() for line in panel.stage.path]
    assert len(shown) == 2
    go_on = threading.Event()
    session.worker.ask("hold", lambda: go_on.wait(TIMEOUT))
    session.set_end("start", START + np.float32([0.01, 0, 0]))
    assert "planning ..." in panel.status.content
    assert not panel.stage.arm.root.visible
    assert all(len(set(line.colors.ravel().tolist()[:2])) == 1 for line in panel.stage.path)
    go_on.set()
    assert session.worker.wait(TIMEOUT)
    assert "certified free" in panel.status.content
    assert panel.stage.arm.root.visible
    session.set_end("start", START)
    assert session.worker.wait(TIMEOUT)
    for line, color in zip(panel.stage.path, shown, strict=True):
        np.testing.assert_array_equal(line.colors, color)


def test_a_start_in_collision_is_told_on_the_page(page):
    session = page.session
    number = page.session.add(SHAPES[1]._replace(values={"center": [0.4, 0, 0], "radius": 0.3}))
    session.set_end("start", np.zeros(3))
    assert session.worker.wait(TIMEOUT)
    assert "no path**: start [0.0, 0.0, 0.0] is in collision" in page.panel.status.content
    assert not page.panel.stage.path
    assert not page.panel.stage.arm.root.visible
    session.remove(number)
    session.set_end("start", START)
    assert session.worker.wait(TIMEOUT)
    assert "certified free" in page.panel.status.content


def test_a_motion_is_played_around_and_around(page):
    player = page.panel.player
    player._turn(True)
    seen = set()
    deadline = time.monotonic() + TIMEOUT
    while len(seen) < 4 and time.monotonic() < deadline:
        seen.add(player.time.value)
        time.sleep(0.02)
    player._turn(False)
    assert len(seen) == 4
    assert max(seen) <= player.time.max


def test_the_roadmap_is_shown_in_the_guides_eyes(page):
    stage = page.panel.stage
    page.panel.least.value = 0.0
    page.panel.prices.value = True
    deadline = time.monotonic() + TIMEOUT
    while not stage.prices and time.monotonic() < deadline:
        time.sleep(0.05)
    edges, nodes = stage.prices
    assert len(edges.points) > 100
    assert len(nodes.points) == 200
    page.panel.prices.value = False
    while stage.prices and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not stage.prices


def test_a_port_that_is_taken_is_refused_in_one_sentence(config, monkeypatch, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SystemExit, match="2"):
            run_command(lambda: main(ViewConfig(port=port, robot=config.robot)))
    told = capsys.readouterr().err
    assert told.startswith(
        f"error: port {port} of '127.0.0.1' cannot be served (Address already in"
    )
    assert len(told.splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"port": 99999}, "port is 99999; choose"),
        ({"port": 0, "start": (1.0, 2.0)}, r"start is \[1.0, 2.0\]; tiny needs 3 joint values"),
        ({"port": 0, "frame": "hook"}, "no site or body 'hook'"),
        ({"port": 0, "velocity": (1.0,), "acceleration": (-1.0,)}, "acceleration"),
    ],
)
def test_what_cannot_be_shown_is_refused(config, options, message):
    with pytest.raises(InputError, match=message):
        open_page(ViewConfig(robot=config.robot, **options))


def test_without_viser_the_extra_is_named(config, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("gnnjax.viewer.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"needs the view extra .*pip install 'gnnjax\[view\]'"):
        open_page(config)


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=_SOFTWARE)
        yield started
        started.close()


def wait_for(fulfilled):
    deadline = time.monotonic() + TIMEOUT
    while not fulfilled():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def pixel(client, point):
    """Where a browser draws a point, m."""
    camera = client.camera
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, camera.wxyz)
    x, y, z = turn.reshape(3, 3).T @ (point - camera.position)
    scale = camera.image_height / 2 / np.tan(camera.fov / 2)
    return camera.image_width / 2 + scale * x / z, camera.image_height / 2 + scale * y / z


@pytest.mark.whole
def test_a_browser_shows_the_page_edits_it_and_may_go_while_it_drags(page, browser, tmp_path):
    import imageio.v3  # which viser needs

    session, start = page.session, page.panel.ends["start"]
    page.server.scene.configure_default_lights(cast_shadow=False)  # a quarter of the drawing
    tab = browser.new_page(viewport={"width": 660, "height": 400})
    tab.goto(f"http://127.0.0.1:{page.port}")
    tab.wait_for_selector("canvas", timeout=1e3 * TIMEOUT)
    tab.get_by_text("certified free").first.wait_for(timeout=1e3 * TIMEOUT)
    wait_for(page.server.get_clients)
    (client,) = page.server.get_clients().values()
    # A joint.
    value = tab.locator("input[type=text]").nth(1)
    value.fill("-1.2")
    value.press("Enter")
    wait_for(lambda: session.end("start")[0] == np.float32(-1.2))
    assert session.worker.wait(TIMEOUT)
    assert session.answer.plan.success
    tab.get_by_text(f"cost {session.answer.plan.cost:.3f} rad").wait_for(timeout=1e3 * TIMEOUT)
    # Obstacles.
    tab.get_by_role("tab", name="Obstacles").click()
    tab.get_by_role("button", name="add").click()
    wait_for(lambda: len(session.shapes) == len(SHAPES) + 1)
    tab.get_by_role("button", name="remove").click()
    wait_for(lambda: len(session.shapes) == len(SHAPES))
    # What is saved.
    tab.get_by_role("tab", name="Save").click()
    for name in ("scene.json", "view.png"):
        with tab.expect_download(timeout=1e3 * TIMEOUT) as download:
            tab.get_by_role("button", name=name).click()
        download.value.save_as(tmp_path / name)
    kept = scene_from_json(tmp_path / "scene.json")
    for found, given in zip(kept[:5], session.query.scene[:5], strict=True):
        np.testing.assert_allclose(found, given, atol=1e-6)
    red, _, blue = np.moveaxis(imageio.v3.imread(tmp_path / "view.png").astype(int), -1, 0)
    assert (blue > red + 20).sum() > 1000  # the ghost at the start
    assert (red > blue + 20).sum() > 1000  # obstacles, and the ghost at the goal
    # The hand at the start, by the arrow of its x axis.
    before, turn = session.end("start"), np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.array(start.handles.wxyz))
    arrow = np.array(start.handles.position) + 0.2 * turn.reshape(3, 3)[:, 0]
    x, y = pixel(client, arrow)
    tab.mouse.move(x, y)
    tab.mouse.down()
    steps = itertools.count(1)

    def drag():  # until it is seen, however slowly the browser draws
        step = next(steps) % 20
        tab.mouse.move(x - 3 * step, y - step)
        return not np.array_equal(session.end("start"), before)

    wait_for(drag)
    assert start.dragged
    # The browser goes in mid-drag, and the server goes on; the handles come back to the hand.
    tab.close()
    wait_for(lambda: not page.server.get_clients() and not start.dragged)
    assert session.worker.wait(TIMEOUT)
    hand = Frames(session.robot).tip(session.end("start"))
    np.testing.assert_allclose(start.handles.position, hand[0], atol=1e-6)
    np.testing.assert_allclose(start.handles.wxyz, hand[1], atol=1e-6)
    # The next browser sees what there is.
    session.set_end("start", START)
    assert session.worker.wait(TIMEOUT)
    assert "certified free" in page.panel.status.content
    tab = browser.new_page(viewport={"width": 660, "height": 400})
    tab.goto(f"http://127.0.0.1:{page.port}")
    tab.get_by_text(f"cost {session.answer.plan.cost:.3f} rad").wait_for(timeout=1e3 * TIMEOUT)
    shown = tab.locator("input[type=text]")
    values = [float(shown.nth(1 + i).input_value()) for i in range(3)]
    np.testing.assert_allclose(values, START, atol=1e-6)
    tab.close()
