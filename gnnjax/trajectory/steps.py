"""Motions at every step of their simulation."""

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import inverse_dynamics_by_mujoco
from gnnjax.errors import InputError
from gnnjax.trajectory.simulate import DT
from gnnjax.trajectory.states import Setpoints, followed
from gnnjax.trajectory.trajectory import Trajectory

HOLD = 0.5  # s at the goal, before it is told whether the arm rests there
_LONGEST = 600.0  # s, whose states fit into memory


def at_steps(robot: Robot, trajectory: Trajectory | Setpoints) -> Setpoints:
    """A motion at every step of the simulation, held at its goal in the end.

    Of states that are given, accelerations are those of cubics between them. Where jerk leaps
    from one state to the next, these leave limits of it by up to a seventh of the leap.
    """
    given, positions, velocities, accelerations = followed(robot, trajectory, DT)
    last = float(given[-1])
    if not last <= _LONGEST:
        raise InputError(f"the motion takes {last:g} s; up to {_LONGEST:g} s can be simulated")
    count = int(np.ceil(last / DT - 1e-9))
    if accelerations is not None:
        count = len(positions) - 1
    times = np.arange(count + round(HOLD / DT)) * DT
    moving = np.arange(len(times)) < count
    q, velocity, acceleration = (np.zeros((len(times), robot.num_dof)) for _ in range(3))
    q[:] = positions[-1]
    if accelerations is not None:  # at these very times, and at the last one
        exact = positions, velocities, accelerations
        for values, part in zip(exact, (q, velocity, acceleration), strict=True):
            part[moving] = values[:-1]
    elif moving.any():
        from scipy.interpolate import CubicHermiteSpline  # a third of a second, for this alone

        curve = CubicHermiteSpline(given, positions, velocities)
        for number, part in enumerate((q, velocity, acceleration)):
            part[moving] = curve(times[moving], number)
    torques = inverse_dynamics_by_mujoco(robot, q, velocity, acceleration)
    return Setpoints(times, q, velocity, acceleration, torques)
