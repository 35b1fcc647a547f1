"""Inverse dynamics against MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.scene.shapes import sphere
from gnnjax.trajectory.dynamics import (
    check_dynamics,
    inverse_dynamics,
    inverse_dynamics_by_mujoco,
    path_dynamics,
)
from tests.arms import HEAVY, ODD


@pytest.fixture(scope="module")
def heavy(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "heavy.xml"
    path.write_text(HEAVY)
    return load_robot(path)


def states(robot, number=20):
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (number, robot.num_dof))
    return q, *rng.normal(size=(2, number, robot.num_dof))


def by_mj_inverse(robot, q, velocity, acceleration):
    """Contacts and limits left out, but nothing else."""
    data, found = mujoco.MjData(robot.mj_model), []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(q, velocity, acceleration, strict=True):
        mujoco.mj_inverse(robot.mj_model, data)
        found.append(data.qfrc_inverse + data.qfrc_constraint)
    return np.array(found)


@pytest.mark.parametrize("name", ["heavy", "franka_panda"])
def test_torques_are_those_of_mujoco(heavy, name):
    robot = heavy if name == "heavy" else load_robot(name)
    wanted = by_mj_inverse(robot, *states(robot))
    with jax.enable_x64(True):
        found = inverse_dynamics(robot, *map(jnp.asarray, states(robot)))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())
    np.testing.assert_allclose(inverse_dynamics_by_mujoco(robot, *states(robot)), wanted, atol=1e-9)


def test_torques_along_a_path_are_those_of_its_states(heavy):
    q, slope, bend = states(heavy)
    x, u = 1.7, -0.6
    wanted = by_mj_inverse(heavy, q, slope * np.sqrt(x), slope * u + bend * x)
    with jax.enable_x64(True):
        inertia, speed, rest, damping = path_dynamics(heavy, *map(jnp.asarray, (q, slope, bend)))
        found = inertia * u + speed * x + rest + damping * np.sqrt(x)
    np.testing.assert_allclose(found, wanted, atol=1e-10 * np.abs(wanted).max())


def test_what_an_arm_holds_weighs_on_it(tiny_path):
    robot = load_robot(tiny_path)
    held = robot.attach("lower", [sphere([0.3, 0, 0], 0.03)], mass=2.0)
    check_dynamics(held)
    q = np.zeros((1, 3))
    alone, both = (inverse_dynamics_by_mujoco(r, q, q, q)[0] for r in (robot, held))
    assert both[1] - alone[1] == pytest.approx(-2.0 * 9.81 * 0.3)


def test_forces_that_are_not_known_are_refused(tmp_path):
    path = tmp_path / "fluid.xml"
    path.write_text(ODD.replace("<mujoco>", '<mujoco><option density="1000"/>', 1))
    with pytest.raises(InputError, match="is moved by other forces than inertia, gravity"):
        check_dynamics(load_robot(path))
