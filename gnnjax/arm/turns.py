"""Joint values a whole turn apart, at which an arm's links are in the same places."""

import itertools

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief


def in_all_turns(robot: Robot, q: ArrayLike) -> Float[np.ndarray, "G D"]:
    """A configuration, and all others within the limits that have every link in the same place:
    joints that turn by more than 2 pi have another value for each whole turn.

    As `goals` of a query they let the arm arrive in whichever turn is nearest:

        planner.plan(scene, start, goals=in_all_turns(robot, goal))

    Args:
        robot: the arm.
        q: `[D]` rad or m, within the limits.

    Returns:
        `q` first, then the nearest to it.

    Raises:
        InputError: q is no configuration within the limits.
    """
    try:
        given = np.asarray(q, np.float32)
    except (TypeError, ValueError, OverflowError):
        given = np.zeros(0, np.float32)
    lower, upper = robot.joint_lower, robot.joint_upper
    if given.shape != (robot.num_dof,):
        raise InputError(
            f"the configuration is {brief(q)}; {robot.name} needs {robot.num_dof} joint values "
            "within its limits"
        )
    if fault := limit_fault(robot, given):
        raise InputError(f"the configuration {fault[1]}")
    values = []
    for value, low, high, turns in zip(
        given, lower, upper, robot.turns_more_than_once, strict=True
    ):
        number = np.arange(-np.ceil((high - low) / (2 * np.pi)) if turns else 0, 1)
        number = np.append(number, -number[:-1])
        others = (value + 2 * np.pi * number).astype(np.float32)
        values.append(others[(others >= low) & (others <= high)])
    found = np.array(list(itertools.product(*values)), np.float32)
    return found[np.argsort(np.linalg.norm(found - given, axis=1), kind="stable")]


def limit_fault(robot: Robot, q: np.ndarray) -> tuple[int, str] | None:
    """The first joint that a configuration `[D]` has beyond its limits, or at no number, and what
    is wrong with it, for a message; None where there is none."""
    outside = ~((q >= robot.joint_lower) & (q <= robot.joint_upper))  # so for NaN
    if not outside.any():
        return None
    joint = int(outside.argmax())
    low, high = robot.joint_lower[joint], robot.joint_upper[joint]
    name = robot.joint_names[joint]
    return (
        joint,
        f"has {q[joint]:.4g} for joint {name}; it must lie between {low:.4g} and {high:.4g}",
    )
