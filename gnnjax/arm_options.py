"""Which arm a command is about, once: for all commands."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from gnnjax.arm.robot import Robot, load_robot
from gnnjax.arm.torques import Amounts
from gnnjax.errors import InputError
from gnnjax.scene.holding import attach_from_json


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointOptions:
    """What is planned for of an arm."""

    joints: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="JOINT [JOINT ...]")] = None
    """Joints to plan for, in the order of the file; by default all that are neither held nor
    coupled to others."""
    hold: Annotated[
        tuple[tuple[str, float], ...], tyro.conf.arg(metavar="JOINT VALUE [JOINT VALUE ...]")
    ] = ()
    """Joints that do not move, and their values, rad or m: finger_1 0.04 finger_2 0.04. Other
    joints that are not planned for are held at home, or at zero."""
    allow: Annotated[
        tuple[tuple[str, str], ...], tyro.conf.arg(metavar="BODY BODY [BODY BODY ...]")
    ] = ()
    """Bodies that may touch, two by two, besides those that the file excludes: hand link_4 base
    link_2."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmOptions(JointOptions):
    """An arm, and what is planned for of it."""

    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF or URDF."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class HoldingOptions(ArmOptions):
    """An arm with what it holds."""

    attach: Path | None = None
    """JSON file with what the arm holds: {"body": NAME, "boxes": [...]}, lists as in a scene, in
    the frame of that body; "mass" (kg) and "allow" (bodies that it may touch) if need be."""
    rest_share: float | None = None
    """Plan only where the arm can be held with this share (0 to 1] of its motors' torques, payload
    included. Leave some for moving. Default: no such limit."""


def load_bare_arm(name: str, options: JointOptions) -> Robot:
    """The arm of a name or path, of which options choose, and which holds nothing.

    Raises:
        InputError: a joint that is to be held twice; see `load_robot`.
    """
    names = [name for name, _ in options.hold]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"joint {twice[0]!r} is held at two values; give it one of them")
    return load_robot(name, joints=options.joints, hold=dict(options.hold), allow=options.allow)


def load_arm(options: HoldingOptions, torque: Amounts | None = None) -> Robot:
    """The arm, with what it holds, and the share of torques that may hold it: of those of its
    model, or of `torque`.

    Raises:
        InputError: see `load_bare_arm`, `attach_from_json` and `Robot.at_rest_within`.
    """
    robot = load_bare_arm(options.robot, options)
    if options.attach is not None:
        robot = attach_from_json(robot, options.attach)
    share = options.rest_share
    return robot if share is None else robot.at_rest_within(share, torque=torque)
