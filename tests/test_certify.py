"""Certification against a fine scan with MuJoCo's C engine."""

import itertools

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import (
    certify_edges,
    certify_path,
    configuration_clearance,
    path_clearance,
)
from gnnjax.errors import InputError
from gnnjax.planning.query import check_query
from gnnjax.scene.scene import make_scene
from tests.fine_scan import collides_anywhere, random_scene

# Skew axes, anchors off the origin, a reference angle, a slide joint and several joints on a body.
ODD = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body pos="0.1 -0.2 0.3" quat="0.6 0.1 -0.7 0.2">
      <joint axis="1 2 -0.5" pos="0.05 -0.03 0.2" range="-3 3"/>
      <geom type="sphere" size="0.05" contype="1" conaffinity="1" mass="1"/>
      <body pos="0 0 0.4" quat="1 0 0 1">
        <joint type="slide" axis="0.3 0 1" range="-0.4 0.5" ref="0.1"/>
        <joint axis="0 0 -1" pos="0.1 0 0" range="-2 2" ref="0.7"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0.2 0 0.1" mass="1"/>
        <body pos="0.2 0 0" quat="0 1 0 0">
          <body pos="0 0.3 0">
            <joint axis="0 -0.6 0.8" pos="0 0 -0.1" range="-2 2" ref="-0.4"/>
            <geom type="sphere" size="0.06" pos="0.1 0 0" mass="1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def robots(tiny_path, tmp_path_factory):
    odd = tmp_path_factory.mktemp("robots") / "odd.xml"
    odd.write_text(ODD)
    return {
        "tiny": load_robot(tiny_path),
        "odd": load_robot(odd),
        "kuka_iiwa14": load_robot("kuka_iiwa14"),
    }


@pytest.mark.parametrize(
    ("name", "num_edges", "share"), [("tiny", 60, 0.95), ("odd", 60, 0.9), ("kuka_iiwa14", 16, 0.9)]
)
def test_certified_edges_are_free_in_a_fine_scan_and_most_free_edges_are_certified(
    robots, name, num_edges, share
):
    robot, rng = robots[name], np.random.default_rng(0)
    free = certified = refuted = 0
    for _ in range(num_edges):
        scene = random_scene(rng, num=5)
        edge = rng.uniform(robot.joint_lower, robot.joint_upper, (2, robot.num_dof))
        edge[1] = edge[0] + 0.3 * (edge[1] - edge[0])
        yes = certify_path(robot, scene, edge)
        hit = collides_anywhere(robot, scene, edge)
        assert not (yes and hit)
        free, certified, refuted = free + (not hit), certified + yes, refuted + hit
    assert certified >= share * free > 0
    assert refuted >= 3


def test_a_collision_between_the_samples_of_a_planner_is_found(robots):
    robot = robots["tiny"]
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_kinematics(robot.mj_model, data)
    tip, radius = data.geom_xpos[robot.geom_ids[-1]], robot.geom_radii[-1]
    # The tip grazes a needle for 0.014 rad, in the middle between two configurations 0.05 apart.
    edge = np.array([[1.3, 0.0, 0.0], [1.8, 0.0, 0.0]])
    angle = np.arctan2(tip[1], tip[0]) + 1.525
    reach = np.hypot(tip[0], tip[1]) + radius - 2e-4
    center = [reach * np.cos(angle), reach * np.sin(angle), tip[2]]
    scene = make_scene([center], [[1e-5, 1e-5, 1e-5]])
    assert not collides_anywhere(robot, scene, edge, step=0.05)
    assert collides_anywhere(robot, scene, edge, step=0.002)
    assert not certify_path(robot, scene, edge)


def test_a_motion_outside_the_joint_limits_is_not_certified(robots):
    scene = make_scene([], [])
    edges = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([[1.0, 0, 0], [3.5, 0, 0]])
    np.testing.assert_array_equal(certify_edges(robots["tiny"], scene, *edges), [True, False])


def test_a_path_of_one_configuration_is_certified_by_its_clearance(robots):
    scene = make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    assert not certify_path(robots["tiny"], scene, np.zeros((1, 3)))
    assert certify_path(robots["tiny"], scene, np.array([[2.0, 0.0, 0.0]]))


def test_the_clearance_of_a_path_is_the_least_along_it(robots):
    robot, rng = robots["tiny"], np.random.default_rng(1)
    path = rng.uniform(robot.joint_lower, robot.joint_upper, (3, robot.num_dof))
    scene = random_scene(rng, num=3)
    fine = [a + t * (b - a) for a, b in itertools.pairwise(path) for t in np.linspace(0, 1, 2000)]
    least = min(configuration_clearance(robot, scene, q) for q in fine)
    # No point of the arm, 1 m long, moves by more than 0.03 m to the next sample.
    assert least - 1e-6 <= path_clearance(robot, scene, path, 0.02) <= least + 0.03
    assert path_clearance(robot, scene, path, 0.001) == pytest.approx(least, abs=2e-3)


def test_a_slide_joint_reaches_as_far_as_it_is_from_its_reference(tmp_path):
    # It travels 0.1 m, but carries the ball around a circle of 1 m.
    path = tmp_path / "crane.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body>'
        '<joint axis="0 0 1" range="-3 3"/><joint type="slide" axis="1 0 0" range="0.9 1"/>'
        '<geom type="sphere" size="0.05" mass="1"/></body></worldbody></mujoco>'
    )
    scene = make_scene([[0.94, 0.14, 0.0]], [[0.02, 0.02, 0.02]])
    edge = np.array([[-0.2, 0.95], [0.2, 0.95]])
    robot = load_robot(path)
    assert collides_anywhere(robot, scene, edge)
    assert not certify_path(robot, scene, edge)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"centers": np.nan}, r"existing box 0 of the scene has centers \[nan, .* must be finite"),
        ({"centers": np.inf}, "centers .* must be finite"),
        ({"centers": 1e7}, "centers .* below 10000"),
        ({"half_extents": -0.1}, r"half_extents \[-0.1.* must be positive"),
        ({"half_extents": 0.0}, "half_extents .* must be positive"),
        ({"half_extents": np.nan}, "half_extents .* must be positive"),
        ({"quats": 0.0}, r"quats \[0.0, 0.0, 0.0, 0.0\], which must be of length 1"),
        ({"quats": 1e20}, "quats .* must be of length 1"),
        ({"quats": 0.7}, "quats .* must be of length 1"),
        ({"quats": np.nan}, "quats .* must be of length 1"),
    ],
)
def test_nothing_is_certified_among_boxes_that_are_none(robots, change, message):
    good = make_scene([[2.0, 0.0, 0.0]], [[0.1] * 3])
    name, value = next(iter(change.items()))
    array = getattr(good, name).copy()
    array[0] = value
    bad, path = good._replace(**{name: array}), np.zeros((2, 3))
    assert certify_path(robots["tiny"], good, path)
    for certified in (
        lambda: certify_path(robots["tiny"], bad, path),
        lambda: certify_edges(robots["tiny"], bad, path[:1], path[1:]),
        lambda: configuration_clearance(robots["tiny"], bad, path[0]),
        lambda: check_query(robots["tiny"], bad, path[0], path[1]),
    ):
        with pytest.raises(InputError, match=message):
            certified()
    # Where no box is, anything may lie.
    assert certify_path(robots["tiny"], bad._replace(mask=np.zeros(10, bool)), path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": np.ones(10, int)}, r"mask of the scene is int64 \(10,\)"),
        ({"mask": np.ones(3, bool)}, r"centers of the scene have shape \(10, 3\); give \[3, 3\]"),
        ({"quats": np.ones((10, 3))}, "quats of the scene have shape"),
    ],
)
def test_a_scene_of_other_arrays_is_refused(robots, change, message):
    scene = make_scene([[2.0, 0.0, 0.0]], [[0.1] * 3])._replace(**change)
    with pytest.raises(InputError, match=message):
        certify_path(robots["tiny"], scene, np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (np.zeros((0, 3)), "holds no configuration"),
        ([], r"path has shape \(0,\); tiny needs \[N, 3\]"),
        (np.zeros((2, 4)), r"path has shape \(2, 4\); tiny needs \[N, 3\]"),
        (np.zeros(3), r"path has shape \(3,\)"),
        ([["a", "b", "c"]], "path is not an array of numbers"),
    ],
)
def test_a_path_of_another_shape_is_refused(robots, path, message):
    with pytest.raises(InputError, match=message):
        certify_path(robots["tiny"], make_scene([], []), path)


def test_what_is_not_a_number_is_not_certified(robots):
    path = np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0], [0.0, 0.0, 0.0]])
    assert not certify_path(robots["tiny"], make_scene([], []), path)
    with pytest.raises(InputError, match="2 starts and 1 ends"):
        certify_edges(robots["tiny"], make_scene([], []), np.zeros((2, 3)), np.zeros((1, 3)))


def test_a_quaternion_of_nearly_length_one_turns_a_box_as_if_it_were(robots):
    quat = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_quat(scalar_first=True)
    scene = make_scene([[1.0, 0.3, 0.3]], [[0.05, 0.2, 0.1]], [quat])
    longer = scene._replace(quats=scene.quats * 1.00009)
    found = [configuration_clearance(robots["tiny"], s, np.zeros(3)) for s in (scene, longer)]
    assert found[0] == pytest.approx(found[1], abs=1e-6)
