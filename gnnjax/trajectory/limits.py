"""What the joints of an arm can do."""

from typing import NamedTuple

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm.shipped import in_kind
from gnnjax.arm.torques import Amounts, own_torques, positive_amounts
from gnnjax.errors import InputError

ANY_TORQUE = 1e9  # N m or N: what no arm needs, and a number, as infinity is not when it cancels


class Limits(NamedTuple):
    """Of D joints, either way."""

    velocity: np.ndarray  # [D] rad/s or m/s
    acceleration: np.ndarray  # [D] rad/s^2 or m/s^2
    torque: np.ndarray | None  # [D] N m or N, `ANY_TORQUE` of joints without; None: all are without
    jerk: np.ndarray | None = None  # [D] rad/s^3 or m/s^3; None: any


_REMEDIES = {
    "velocity": "rad/s",
    "acceleration": "rad/s^2; makers of arms name 1 to 20, and 5 is moderate",
}


def limits_of(
    robot: Robot,
    *,
    velocity: Amounts | None = None,
    acceleration: Amounts | None = None,
    torque: Amounts | None = None,
    jerk: Amounts | None = None,
) -> Limits:
    """The limits that an arm's model has, but for those that are given: a number a joint, or one
    for all.

    Torques are not limited where neither the model nor an argument does so, joint by joint, nor is
    jerk.

    Raises:
        InputError: a limit that is not positive, or too many of them; no velocities, or no
            accelerations; a joint of the model that motors push one way only.
    """
    given = {"velocity": velocity, "acceleration": acceleration, "torque": torque, "jerk": jerk}
    found = {}
    for name, values in given.items():
        own = values is None
        found[name] = _own(robot, name) if own else positive_amounts(robot, name, values)
        if found[name] is None and name in _REMEDIES:
            where = in_kind(
                robot.path,
                mjcf=f'<numeric name="{name}_limit"> into its MJCF',
                urdf=f'{name}="..." into each <limit> of its URDF',
            )
            raise InputError(
                f"the model of {robot.name} has no {name} limits; give {name}=... "
                f"({_REMEDIES[name]}), or put {where}"
            )
    return Limits(*(None if x is None else np.asarray(x, float) for x in found.values()))


def _own(robot: Robot, name: str) -> np.ndarray | None:
    """Limits of the model; those of torques as far as it has them."""
    if name == "jerk":  # which models lack
        return None
    if name == "torque":
        limits = own_torques(robot)
        return np.minimum(limits, ANY_TORQUE) if np.isfinite(limits).any() else None
    return getattr(robot, f"{name}_limit")
