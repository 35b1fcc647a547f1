"""Where parts of an arm meet nearly wherever it is, another configuration is no remedy."""

import numpy as np
import pytest

from gnnjax.arm.meetings import meeting_share
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.planning.query import check_query
from gnnjax.scene.scene import make_scene
from gnnjax.scene.shapes import box, sphere

# Two fingers that are planned for; the second cannot be far from the first, but for its last bit.
HAND = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body name="hand"><joint name="turn" range="-2 2"/><geom type="sphere" size="0.05"/>
    <body name="left" pos="0.2 0 0"><joint name="l" type="slide" range="0 0.1" axis="1 0 0"/>
      <geom name="left" type="sphere" size="0.05"/></body>
    <body name="right" pos="0.275 0 0"><joint name="r" type="slide" range="0 0.1" axis="1 0 0"/>
      <geom name="right" type="sphere" size="0.05"/></body>
  </body></worldbody></mujoco>"""
FREE = make_scene([], [])


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    path = tmp_path_factory.mktemp("hand") / "hand.xml"
    path.write_text(HAND)
    return load_robot(path)


def test_the_share_is_that_of_random_configurations(hand):
    numbers = {part.name: number for number, part in enumerate(hand.parts)}
    # They meet where l - r > -0.025, of l and r from 0 to 0.1.
    share = meeting_share(hand, numbers["left"], numbers["right"])
    assert share == pytest.approx(1 - 0.5 * 0.75**2, abs=0.1)
    assert meeting_share(hand, 0, numbers["right"]) == 0


@pytest.mark.parametrize("end", ["start", "goal"])
def test_links_that_meet_nearly_always_may_be_allowed_to(hand, end):
    q = {"start": [0.0, 0.0, 0.1], "goal": [0.5, 0.0, 0.1]} | {end: [0.0, 0.0, 0.0]}
    message = rf"{end} \[.*\] is in collision: left and right overlap by 25.0 mm, as they do in .. "
    message += r"% of all configurations; if they may, give allow=\[\('left', 'right'\)\]$"
    with pytest.raises(InputError, match=message):
        check_query(hand, FREE, np.array(q["start"]), np.array(q["goal"]))


def test_links_are_links_however_they_are_called(tmp_path):
    path = tmp_path / "hand.xml"
    path.write_text(HAND.replace('"left"', '"held_left"'))
    with pytest.raises(InputError, match=r"give allow=\[\('held_left', 'right'\)\]$"):
        check_query(load_robot(path), FREE, np.zeros(3), np.array([0.5, 0.0, 0.1]))


def test_what_is_held_may_touch_what_it_always_meets_or_be_held_otherwise(hand):
    allowed = load_robot(hand.path, allow=[("left", "right")])
    holding = allowed.attach("left", [sphere([0.1, 0, 0], 0.06)], allow=["hand"])
    message = r"as they do in .. % of all configurations; let allow of what is held name 'right', "
    with pytest.raises(InputError, match=message + "or hold it in another pose$"):
        check_query(holding, FREE, np.zeros(3), np.zeros(3))


def test_what_is_met_by_chance_is_left_by_another_configuration(hand, tiny):
    block = make_scene([[0.0, 0.2, 0.0]], [[0.02, 0.02, 0.02]])
    with pytest.raises(InputError, match=r"overlap by .* mm; choose a free configuration$"):
        check_query(hand, block, np.array([np.pi / 2, 0.0, 0.1]), np.array([0.0, 0.0, 0.1]))
    folded = tiny.attach("lower", [box([0.1, 0, 0], [0.2, 0.02, 0.02])], allow=["middle"])
    with pytest.raises(InputError, match=r"overlap by .* mm; choose a free configuration$"):
        check_query(folded, FREE, np.array([0.0, 2.5, 2.0]), np.zeros(3))
