"""Pictures of arms along paths: what they show."""

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.robot import load_robot
from gnnjax.plot import draw_cover, draw_plan
from gnnjax.scene.allowed import last_link
from gnnjax.scene.scene import make_scene
from gnnjax.scene.shapes import sphere

PATH = np.array([[-0.5, 0.3, 0.2], [0.8, -0.3, 0.0]], np.float32)
# Twice the length of `TINY`, hanging down, and beside its base.
LARGE = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body name="upper" pos="0 0 -1"><joint name="a" axis="0 1 0" range="-2 2"/>
    <geom type="capsule" size="0.1" fromto="0 0 0 0 0 -2"/>
    <body name="lower" pos="0 0 -2"><joint name="b" axis="0 1 0" range="-2 2"/>
      <geom type="capsule" size="0.1" fromto="0 0 -0.3 0 0 -2"/>
    </body></body></worldbody></mujoco>"""


@pytest.fixture
def figures(monkeypatch):
    """The figures that were saved."""
    saved = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **how: saved.append(figure))
    return saved


def test_all_of_an_arm_is_in_the_picture_and_what_is_far_does_not_make_it_small(tmp_path, figures):
    path = tmp_path / "large.xml"
    path.write_text(LARGE)
    robot = load_robot(path)
    far = make_scene([[90.0, 0.0, -2.0], [1.0, 0.0, -2.0]], [[1.0, 1.0, 1.0], [0.1] * 3])
    draw_plan(robot, far, np.array([[0.0, 0.0], [1.2, 0.3]], np.float32), tmp_path / "arm.svg")
    side = 2 * (np.sin(1.2) + np.sin(1.5)) + 0.1
    for axes in figures[0].axes:
        np.testing.assert_allclose(axes.get_xlim(), [-side, side], atol=1e-3)
        np.testing.assert_allclose(axes.get_ylim(), [-side, side], atol=1e-3)
        np.testing.assert_allclose(axes.get_zlim(), [-5.1, -0.9], atol=1e-3)


def test_the_dotted_line_is_that_of_the_last_link_whatever_else_holds_something(
    tiny, tmp_path, figures
):
    robot = tiny.attach("middle", [sphere([0.1, 0.0, 0.2], 0.03)])
    draw_plan(robot, make_scene([], []), PATH, tmp_path / "arm.svg")
    (line, *_) = figures[0].axes[0].lines
    for end, q in ((0, PATH[0]), (-1, PATH[1])):
        place = forward_kinematics(robot, jnp.asarray(q))[0][last_link(robot)]
        np.testing.assert_allclose(np.array(line.get_data_3d())[:, end], place, atol=1e-6)


def test_a_cover_is_told_in_spheres(tiny, tmp_path, figures):
    draw_cover(tiny, tmp_path / "cover.svg")
    assert figures[0].get_suptitle() == "tiny: 4 spheres"
