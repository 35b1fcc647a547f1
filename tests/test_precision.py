"""Whoever has JAX compute in double precision finds what anybody else does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.pose.goal import PoseGoal
from gnnjax.pose.inverse import inverse_kinematics
from tests.fine_scan import random_scene

SCENE = random_scene(np.random.default_rng(4))


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


def test_poses_are_reached_by_the_same_configurations(robot):
    pose = PoseGoal([0.5, 0.2, 0.5], [1, 0, 0, 0], free=("rx", "ry", "rz"))
    usual = inverse_kinematics(robot, pose)
    with jax.enable_x64(True):
        jax.tree.map(np.testing.assert_array_equal, inverse_kinematics(robot, pose), usual)


def test_a_checker_finds_the_same_whatever_it_is_given(robot):
    rng, checker = np.random.default_rng(0), make_checker(robot)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (2, 40, robot.num_dof))
    free = jax.jit(checker.check_configurations)
    usual = free(SCENE, jnp.asarray(q[0], jnp.float32))
    edges = checker.edges_free(SCENE, jnp.asarray(q[0]), jnp.asarray(q[1]))
    assert 0 < usual.sum() < 40
    np.testing.assert_array_equal(checker.check_configurations(SCENE, q[0]), usual)
    with jax.enable_x64(True):
        np.testing.assert_array_equal(free(SCENE, jnp.asarray(q[0])), usual)
        np.testing.assert_array_equal(checker.edges_free(SCENE, *map(jnp.asarray, q)), edges)
