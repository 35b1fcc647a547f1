"""Forward kinematics against MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.robot import load_robot

# Skew axes, anchors off the origin, a reference angle, several joints on a body, a slide joint,
# a branch, and a body without joints.
ODD = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body pos="0.1 -0.2 0.3" quat="0.6 0.1 -0.7 0.2">
      <joint axis="1 2 -0.5" pos="0.05 -0.03 0.2" range="-3 3"/>
      <geom type="sphere" size="0.05" contype="1" conaffinity="1" mass="1"/>
      <body pos="0 0 0.4" quat="1 0 0 1">
        <joint type="slide" axis="0.3 0 1" range="-0.4 0.5"/>
        <joint axis="0 0 -1" pos="0.1 0 0" range="-2 2" ref="0.7"/>
        <joint axis="-1 0 0" range="-2 2"/>
        <geom type="sphere" size="0.05" mass="1"/>
        <body pos="0.2 0 0" quat="0 1 0 0">
          <geom type="sphere" size="0.05" mass="1"/>
          <body pos="0 0.3 0">
            <joint axis="0 -0.6 0.8" pos="0 0 -0.1" range="-2 2"/>
            <geom type="sphere" size="0.05" mass="1"/>
          </body>
        </body>
      </body>
      <body pos="-0.3 0 0">
        <joint type="slide" axis="0 1 0" range="-1 1" ref="0.2"/>
        <geom type="sphere" size="0.05" mass="1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def odd_path(tmp_path):
    path = tmp_path / "odd.xml"
    path.write_text(ODD)
    return path


@pytest.mark.parametrize("name", ["kinova_gen3", "kuka_iiwa14", "franka_panda", "odd"])
def test_forward_kinematics_matches_mujoco(name, odd_path):
    robot = load_robot(odd_path if name == "odd" else name)
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (5, 20, robot.num_dof))
    q = q.astype(np.float32)
    positions, rotations = jax.jit(lambda q: forward_kinematics(robot, q))(jnp.asarray(q))
    num_bodies = len(robot.bodies)
    assert positions.shape == (5, 20, num_bodies, 3)
    assert rotations.shape == (5, 20, num_bodies, 3, 3)
    data = mujoco.MjData(robot.mj_model)
    for index in np.ndindex(5, 20):
        data.qpos[:] = q[index]
        mujoco.mj_kinematics(robot.mj_model, data)
        np.testing.assert_allclose(positions[index], data.xpos[1:], atol=1e-5)
        expected = data.xmat[1:].reshape(num_bodies, 3, 3)
        np.testing.assert_allclose(rotations[index], expected, atol=1e-5)


def test_batch_is_single_configurations(odd_path):
    robot = load_robot(odd_path)
    q = jnp.linspace(robot.joint_lower, robot.joint_upper, 4)
    batch = forward_kinematics(robot, q)
    for b in range(4):
        single = forward_kinematics(robot, q[b])
        for whole, part in zip(batch, single, strict=True):
            np.testing.assert_allclose(whole[b], part, atol=1e-6)


def test_lists_and_whole_numbers_are_configurations_too(odd_path):
    robot = load_robot(odd_path)
    zeros = forward_kinematics(robot, jnp.zeros(robot.num_dof))
    for given in ([0] * robot.num_dof, np.zeros(robot.num_dof), jnp.zeros(robot.num_dof, int)):
        found = forward_kinematics(robot, given)
        jax.tree.map(np.testing.assert_array_equal, found, zeros)
