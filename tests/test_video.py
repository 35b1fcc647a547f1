"""Films of motions."""

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from PIL import Image

from gnnjax import video
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.scene.scene import scene_from_shapes
from gnnjax.scene.shapes import box, capsule, cylinder, half_space, sphere
from gnnjax.video import check_video, draw_video

TIMES = np.linspace(0, 1, 41)
MOTION = np.linspace([0, 0, 0], [1, 0.5, 0.2], 41)
SCENE = scene_from_shapes(
    [
        box([0.6, 0.4, 0], [0.1] * 3),
        sphere([0, 0.8, 0], 0.1),
        capsule([0, -0.8, 0], 0.05, 0.1),
        cylinder([-0.8, 0, 0], 0.1, 0.1),
        half_space([0, 0, -0.5], [0, 0, 1]),
    ]
)


class Painter(mujoco.Renderer):
    """In place of MuJoCo's renderer, without OpenGL: pictures that count what is to be drawn."""

    def __init__(self, model, height, width, max_geom):
        self._model, self.shape = model, (height, width, 3)
        self._scene = mujoco.MjvScene(model, max_geom)

    def update_scene(self, data, camera):
        every, nothing = mujoco.mjtCatBit.mjCAT_ALL, mujoco.MjvPerturb()
        view = mujoco.MjvOption()
        mujoco.mjv_updateScene(self.model, data, view, nothing, camera, every, self.scene)

    def render(self):
        return np.full(self.shape, self.scene.ngeom, np.uint8)

    def close(self):
        pass


def test_each_frame_shows_parts_obstacles_and_the_way_so_far(tiny_path, tmp_path, monkeypatch):
    monkeypatch.setattr(mujoco, "Renderer", Painter)
    robot, drawn = load_robot(tiny_path), []
    monkeypatch.setitem(video._ENCODERS, ".gif", lambda frames, file: drawn.extend(frames))
    draw_video(robot, SCENE, TIMES, MOTION, tmp_path / "motion.gif")
    counts = [int(frame[0, 0, 0]) for frame in drawn]
    still = len(robot.parts) + int(SCENE.mask.sum())
    assert counts == [*range(still, still + 21), *[still + 20] * 10]


def test_a_gif_plays_as_fast_as_the_motion(tiny_path, tmp_path, monkeypatch):
    monkeypatch.setattr(mujoco, "Renderer", Painter)
    draw_video(load_robot(tiny_path), SCENE, TIMES, MOTION, tmp_path / "motion.gif")
    with Image.open(tmp_path / "motion.gif") as image:
        lasted = 0
        for number in range(image.n_frames):
            image.seek(number)
            lasted += image.info["duration"]
    assert lasted == 50 * 31  # ms: 21 of the motion, 10 still ones
    assert [file.name for file in tmp_path.iterdir()] == ["motion.gif"]


def test_an_mp4_can_be_read_again(tiny_path, tmp_path, monkeypatch):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the encoder is not installed")
    monkeypatch.setattr(mujoco, "Renderer", Painter)
    monkeypatch.setattr(video, "_WIDTH", 64)
    monkeypatch.setattr(video, "_HEIGHT", 48)
    file = tmp_path / "motion.mp4"
    draw_video(load_robot(tiny_path), SCENE, TIMES[:9], MOTION[:9], file)
    read = [ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(file), "-f", "rawvideo"]
    done = subprocess.run([*read, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True)
    assert not done.stderr
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, 48, 64, 3)
    assert len(frames) == 5 + 10  # those of the motion, and still ones
    # A geom more in each, which is what their brightness is.
    bright = frames.mean(axis=(1, 2, 3))
    assert bright[4] - bright[0] == pytest.approx(4, abs=2)
    assert np.ptp(bright[4:]) <= 1
    assert [each.name for each in tmp_path.iterdir()] == ["motion.mp4"]


def test_what_cannot_be_filmed_is_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"has the ending '.avi'; give .gif or .mp4"):
        check_video(tmp_path / "motion.avi")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"pip install 'gnnjax\[video\]'"):
        check_video(tmp_path / "motion.mp4")

    def without_opengl(*_, **__):
        raise mujoco.FatalError("an OpenGL platform library has not been loaded")

    monkeypatch.setattr(mujoco, "Renderer", without_opengl)
    with pytest.raises(InputError, match=r"no OpenGL to draw a video .*MUJOCO_GL=egl"):
        check_video(tmp_path / "motion.gif")


def test_mujoco_draws_the_arm_where_there_is_opengl(tiny_path, tmp_path):
    code = f"""
from tests.test_video import MOTION, SCENE, TIMES, draw_video, load_robot
robot = load_robot({str(tiny_path)!r})
draw_video(robot, SCENE, TIMES[:5], MOTION[:5], {str(tmp_path / "a.gif")!r})
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "MUJOCO_GL": "egl"},
    )
    if "no OpenGL" in done.stderr or "import mujoco" in done.stderr:
        pytest.skip("no EGL")
    assert done.returncode == 0, done.stderr
    with Image.open(tmp_path / "a.gif") as image:
        colors = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
    blue = (colors[:, 2] > colors[:, 0] + 60).sum()  # links
    brown = (colors[:, 0] > colors[:, 2] + 40).sum()  # obstacles
    assert blue > 500
    assert brown > 500
