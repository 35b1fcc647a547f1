"""How motions are timed, once: for `planner.plan`, `time_path` and the command."""

import dataclasses
from typing import Annotated, Any

import numpy as np
import tyro

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, check_number, check_option_names
from gnnjax.trajectory.limits import Amounts, Limits, limits_of

# What Python takes in any form is a list of numbers on a command line.
_Given = Annotated[
    Amounts | None,
    tyro.conf.arg(constructor=tuple[float, ...] | None, help_behavior_hint="(default: None)"),
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """How fast a motion may be, and how it goes around corners."""

    velocity: _Given = None
    """Velocity limits of the motion, rad/s (m/s): one for all joints, or one each; the model's by
    default."""
    acceleration: _Given = None
    """Acceleration limits of the motion, rad/s^2 (m/s^2): one for all joints, or one each; the
    model's by default."""
    torque: _Given = None
    """Torque limits of the motion, N m (N): one for all joints, or one each; the model's by
    default, which may have none."""
    jerk: _Given = None
    """Jerk limits of the motion, rad/s^3 (m/s^3): one for all joints, or one each; none by
    default."""
    blend: float = 1.0
    """Most of an edge that a rounded corner of the motion takes, rad (m); with 0 the motion stops
    at corners."""
    clearance: bool = False
    """Also find out how far path and motion stay from all obstacles, which takes longer than timing
    the motion."""


def make_motion_options(**options: Any) -> MotionOptions:
    """Options by name.

    Raises:
        InputError: a name that is no option.
    """
    check_option_names(MotionOptions, options, "a motion")
    return MotionOptions(**options)


def check_motion_options(robot: Robot, options: MotionOptions) -> Limits:
    """The limits of an arm's motions, or what is wrong with the options.

    Raises:
        InputError: limits that are missing or not positive, or a blend that is no length.
    """
    check_number(options.blend, "blend")
    if not 0 <= options.blend < np.inf:
        raise InputError(f"blend is {options.blend}; give a length in configuration units, or 0")
    return limits_of(
        robot,
        velocity=options.velocity,
        acceleration=options.acceleration,
        torque=options.torque,
        jerk=options.jerk,
    )
