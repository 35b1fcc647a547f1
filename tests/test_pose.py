"""Poses: the configurations that reach them, by MuJoCo's own kinematics, and plans to them."""

import inspect
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import check_scene
from gnnjax.collision.clearances import clearances
from gnnjax.errors import InputError
from gnnjax.pose.chain import chain_of, kinematics
from gnnjax.pose.goal import PoseGoal, tool_frame
from gnnjax.pose.inverse import inverse_kinematics
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.scene import make_scene
from gnnjax.scene.shapes import sphere

SIX = """
<mujoco model="six">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom type="sphere" size="0.05" contype="1" conaffinity="1"/>
    <body name="first" pos="0 0 0.2" quat="1 0.2 0 0.1">
      <joint name="rail" type="slide" axis="1 0 0.1" range="-0.4 0.4"/>
      <joint name="a" axis="0 0 1" pos="0.01 0 0" range="-3 3"/>
      <geom type="sphere" size="0.05" pos="0.1 0 0.05" mass="1"/>
      <body name="second" pos="0.1 0 0.1">
        <joint name="b" axis="0 1 0.2" range="-2 2"/>
        <geom type="sphere" size="0.03" pos="0 0 0.15" mass="1"/>
        <body name="third" pos="0 0 0.3">
          <joint name="c" axis="0 1 0" range="-2.5 2.5"/>
          <geom type="sphere" size="0.03" mass="1"/>
          <body name="fourth" pos="0 0 0.1">
            <joint name="d" axis="0 0 1" range="-7 7"/>
            <geom type="sphere" size="0.03" pos="0 0 0.05" mass="1"/>
            <body name="fifth" pos="0 0 0.15">
              <joint name="e" axis="1 0 0" range="-2 2"/>
              <joint name="f" axis="0 0 1" range="-3 3"/>
              <geom type="sphere" size="0.04" pos="0 0 0.1" mass="1"/>
              <site name="tool" pos="0.02 0 0.15" quat="1 0.3 0 0"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def six(tmp_path_factory):
    """An arm on a rail, seven joints in all, two of them on one body and one that turns twice."""
    path = tmp_path_factory.mktemp("robots") / "six.xml"
    path.write_text(SIX)
    return load_robot(path)


def by_mujoco(robot, q, name="tool"):
    """Where MuJoCo's C engine has a site or body: position, rotation, and how q moves them."""
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    jacobian = np.zeros((6, model.nv))
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) >= 0:
        site = model.site(name).id
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        return data.site_xpos[site], data.site_xmat[site].reshape(3, 3), jacobian
    body = model.body(name).id
    mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], body)
    return data.xpos[body], data.xmat[body].reshape(3, 3), jacobian


def pose_at(robot, q, name="tool", **options):
    position, rotation, _ = by_mujoco(robot, q, name)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, rotation.reshape(9))
    frame = None if name == "tool" else name
    return PoseGoal(position, quat, frame=frame, **options)


def apart(robot, q, goal, name="tool"):
    """How the frame lies in the pose: place, and rotation."""
    position, rotation, _ = by_mujoco(robot, q, name)
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, np.asarray(goal.quat))
    turned = turned.reshape(3, 3)
    return turned.T @ (position - goal.position), turned.T @ rotation


def angle(rotation):
    return np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))


def random_configurations(robot, num, seed=0):
    rng = np.random.default_rng(seed)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (10 * num, robot.num_dof))
    return q[clearances(robot, make_scene([], []), q, most=0.0) > 0][:num]


@pytest.mark.parametrize("name", ["tool", "third"])
def test_frames_and_how_joints_move_them_are_those_of_mujoco(six, name):
    tool, rng = tool_frame(six, name), np.random.default_rng(1)
    q = rng.uniform(six.joint_lower, six.joint_upper, (5, six.num_dof))
    target = pose_at(six, q[0], name)
    rotation = by_mujoco(six, q[0], name)[1]
    base = np.concatenate([rotation.T, -rotation.T @ target.position[:, None]], axis=1)
    found = kinematics(chain_of(six, tool), jnp.asarray(base[..., None]), jnp.asarray(q.T))
    for i, one in enumerate(q):
        place, turn = apart(six, one, target, name)
        jacobian = by_mujoco(six, one, name)[2]
        wanted = np.concatenate([rotation.T @ jacobian[:3], rotation.T @ jacobian[3:]])
        np.testing.assert_allclose(found.jacobian[..., i].T, wanted, atol=1e-5)
        np.testing.assert_allclose(found.frame[:, :3, i], turn, atol=1e-5)
        np.testing.assert_allclose(found.frame[:, 3, i], place, atol=1e-5)


def test_every_reachable_pose_is_reached_within_the_limits_as_mujoco_sees_it(six):
    for q in random_configurations(six, 30):
        goal = pose_at(six, q)
        found = inverse_kinematics(six, goal)
        assert found.valid[0]
        for one, place_error, turn_error in zip(
            found.q[found.valid],
            found.position_error[found.valid],
            found.rotation_error[found.valid],
            strict=True,
        ):
            assert (one >= six.joint_lower).all()
            assert (one <= six.joint_upper).all()
            place, turn = apart(six, one, goal)
            assert np.linalg.norm(place) == pytest.approx(place_error, abs=1e-6)
            assert angle(turn) == pytest.approx(turn_error, abs=2e-3)
            assert np.linalg.norm(place) <= 1e-4 + 1e-6
            assert angle(turn) <= 1e-3 + 1e-4
        assert (clearances(six, make_scene([], []), found.q[found.valid], most=0.0) > 0).all()


def test_solutions_are_distinct_and_come_nearest_first(six):
    q = random_configurations(six, 1, seed=2)[0]
    found = inverse_kinematics(six, pose_at(six, q), near=q, num_solutions=12)
    num = int(found.valid.sum())
    assert num >= 3
    assert found.valid[:num].all()
    assert (np.diff(found.distance[:num]) >= 0).all()
    np.testing.assert_allclose(found.q[0], q, atol=1e-3)  # where the first descent begins
    for a, b in itertools.combinations(found.q[:num], 2):
        assert np.linalg.norm(a - b) > 0.1
    again = inverse_kinematics(six, pose_at(six, q), near=q, num_solutions=12)
    jax.tree.map(np.testing.assert_array_equal, found, again)


def test_joints_that_turn_twice_turn_the_way_that_is_near(six):
    q = random_configurations(six, 1, seed=4)[0]
    for value in (-5.0, 5.0):
        q[4] = value
        found = inverse_kinematics(six, pose_at(six, q), near=q)
        np.testing.assert_allclose(found.q[0], q, atol=1e-3)


@pytest.mark.parametrize("free", [["rz"], ["rx"], ["x"], ["y", "rz"], ["rx", "ry", "rz"]])
def test_free_axes_are_those_of_the_pose_and_the_others_are_kept(six, free):
    for q in random_configurations(six, 5, seed=3):
        goal = pose_at(six, q)._replace(free=free)
        found = inverse_kinematics(six, goal)
        assert found.valid[:4].all()
        moved, turned = [], []
        for one in found.q[:4]:
            place, turn = apart(six, one, goal)
            kept = [i for i, axis in enumerate("xyz") if axis not in free]
            assert np.abs(place[kept]).max() < 2e-4
            moved.append(np.abs(np.delete(place, kept)).max(initial=0.0))
            axes = [i for i, axis in enumerate(("rx", "ry", "rz")) if axis in free]
            if len(axes) == 1:
                assert turn[axes[0], axes[0]] > 1 - 1e-5  # that axis is where it should be
            elif not axes:
                assert angle(turn) < 2e-3
            turned.append(angle(turn))
        # What is free is made use of.
        assert max(moved) > 0.01 or not set(free) & set("xyz")
        assert max(turned) > 0.1 or not set(free) & {"rx", "ry", "rz"}


def test_many_poses_are_solved_as_each_alone(six):
    q = random_configurations(six, 18, seed=5)
    goals = [pose_at(six, x) for x in q]
    stacked = PoseGoal(
        np.reshape([goal.position for goal in goals], (2, 9, 3)),
        np.reshape([goal.quat for goal in goals], (2, 9, 4)),
    )
    found = inverse_kinematics(six, stacked, num_solutions=1)
    assert found.q.shape == (2, 9, 1, 7)
    for one, goal in zip(found.q.reshape(18, 7), goals, strict=True):
        alone = inverse_kinematics(six, goal, num_solutions=1)
        np.testing.assert_array_equal(one, alone.q[0])


def test_what_collides_is_not_valid_and_comes_after_what_does_not(six):
    q = random_configurations(six, 1, seed=6)[0]
    goal = pose_at(six, q)
    elbow = by_mujoco(six, q, "third")[0]
    scene = make_scene([elbow], [[0.02] * 3])
    found = inverse_kinematics(six, goal, scene, near=q, num_solutions=40)
    rows = found.reached
    free = clearances(six, scene, found.q[rows], most=0.0) > 0
    np.testing.assert_array_equal(found.valid[rows], free)
    assert found.valid[0]
    assert (np.diff(found.valid[rows].astype(int)) <= 0).all()


def test_rows_that_are_left_over_hold_nothing(six):
    goal = pose_at(six, random_configurations(six, 1)[0])
    found = inverse_kinematics(six, goal, num_solutions=70)
    assert not np.isnan(found.q[0]).any()
    assert np.isnan(found.q[-1]).all()
    assert not found.valid[-1]


def test_a_pose_out_of_reach_comes_with_how_near_the_arm_came(tiny):
    goal = PoseGoal([0.5, 0.3, 0.2], [1.0, 0.0, 0.0, 0.0])
    found = inverse_kinematics(tiny, goal)
    assert not found.reached.any()
    place, turn = apart(tiny, found.q[0], goal, "lower")
    assert np.linalg.norm(place) == pytest.approx(found.position_error[0], abs=1e-5)
    assert angle(turn) == pytest.approx(found.rotation_error[0], abs=1e-3)
    assert (np.diff(found.position_error + 0.3 * found.rotation_error)[:3] >= 0).all()


def test_a_joint_that_turns_often_is_in_the_turn_within_limits_that_is_nearest(tmp_path):
    path = tmp_path / "often.xml"
    path.write_text(SIX.replace("-7 7", "-12 12"))
    robot, q = load_robot(path), np.zeros(7, np.float32)
    goal, d = pose_at(robot, q), robot.joint_names.index("d")
    for near in (11.9, 5.0, -11.9):
        q[d] = near
        found = inverse_kinematics(robot, goal, near=q)
        values = found.q[found.valid][:, d]
        assert len(values) > 1
        for turn in (-2 * np.pi, 2 * np.pi):
            other = values + turn
            assert ((abs(other) > 12) | (abs(other - near) > abs(values - near) - 1e-4)).all()


def test_joints_that_do_not_move_the_frame_stay_where_they_are(six):
    near = random_configurations(six, 1)[0]
    goal = pose_at(six, random_configurations(six, 2, seed=5)[1], "second")
    found = inverse_kinematics(six, goal, near=near)
    assert found.valid.any()
    own = [six.joint_names.index(name) for name in ("c", "d", "e", "f")]
    assert abs(found.q[found.valid][:, own] - near[own]).max() < 1e-6


GOOD = PoseGoal([0.5, 0.0, 0.3], [1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"quat": [0.0, 0, 0, 0]},
            r"the quaternion \[0.0, 0.0, 0.0, 0.0\]; it must be of length 1",
        ),
        ({"quat": [1.0, 0, np.nan, 0]}, "the quaternion .*nan.* must be of length 1"),
        ({"quat": [0.0, 2.0, 0, 0]}, "the quaternion .* must be of length 1, as w x y z"),
        ({"position": [0.0, np.inf, 0]}, r"the position \[0.0, inf, 0.0\]; it must be finite"),
        ({"position": [0.0, 0.0]}, r"a position of shape \(2,\) and a quaternion of shape \(4,\)"),
        ({"position": np.zeros((0, 3)), "quat": np.zeros((0, 4))}, r"of shape \(0, 3\)"),
        ({"position": ["a", 0, 0]}, "not made of numbers"),
        ({"free": "rz"}, "free axes 'rz'; give a list"),
        ({"free": (x for x in ["rz"])}, "free axes <generator.*; give a list"),
        ({"free": ["roll"]}, r"free axes \['roll'\]; give a list of \['x', 'y'"),
        ({"free": ["rx", "ry"]}, r"\['rx', 'ry'\] free; give one axis of turns, or all three"),
        ({"free": ["x", "y", "z", "rx", "ry", "rz"]}, "all axes free, and asks for nothing"),
        ({"tolerance": (0.0, 0.1)}, "the tolerance is .* both above 0"),
        ({"frame": ["hook"]}, r"the frame is \['hook'\]; give the name of a site or body"),
        ({"frame": "hook"}, r"no site or body 'hook' in tiny; there are \['upper', 'middle', 'low"),
    ],
)
def test_a_bad_pose_is_refused_with_its_value(tiny, change, message):
    with pytest.raises(InputError, match=message):
        inverse_kinematics(tiny, GOOD._replace(**change))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"near": [0.0, 1.0]}, r"near is \[0.0, 1.0\]; tiny needs 3 joint values"),
        ({"near": [0.0, np.nan, 0.0]}, "near is .*; tiny needs 3 joint values"),
        ({"num_solutions": 0}, "num_solutions is 0; ask for 1 or more"),
        ({"num_solutions": True}, "num_solutions is True; ask for 1 or more"),
        ({"margin": -0.1}, "margin is -0.1; it must be 0 m or more"),
        ({"seed": -1}, "seed is -1"),
        ({"scene": stack_scenes([make_scene([], [])] * 2)}, "the scene is 2 in one; give one"),
        ({"near": [0.0, 10**400, 0.0]}, "near is .*; tiny needs 3 joint values"),
    ],
)
def test_bad_options_are_refused(tiny, options, message):
    with pytest.raises(InputError, match=message):
        inverse_kinematics(tiny, GOOD, **options)


def test_what_is_no_scene_is_refused(tiny, monkeypatch):
    monkeypatch.setattr("gnnjax.pose.inverse.check_scene", inspect.unwrap(check_scene))
    with pytest.raises(InputError, match="the scene is a int; make one with make_scene"):
        inspect.unwrap(inverse_kinematics)(tiny, GOOD, 5)


def test_a_quaternion_that_is_nearly_of_length_1_is_normalized(six):
    goal = pose_at(six, random_configurations(six, 1)[0])
    near = inverse_kinematics(six, goal._replace(quat=1.003 * goal.quat))
    np.testing.assert_allclose(near.q, inverse_kinematics(six, goal).q, atol=1e-4)


def test_the_default_frame_is_the_tool_or_else_the_last_body(six, tiny):
    assert tool_frame(six).name == "tool"
    assert tool_frame(tiny).name == "lower"
    laden = tiny.attach("upper", [sphere([0.1, 0, 0.1], 0.01)])  # hangs there after "lower"
    assert tool_frame(laden).name == "lower"
    for name in ("kuka_iiwa14", "kinova_gen3", "franka_panda"):
        assert tool_frame(load_robot(name)).name == "tool"
    with pytest.raises(InputError, match="'link_0' of kuka_iiwa14 is moved by no joint"):
        tool_frame(load_robot("kuka_iiwa14"), "link_0")
