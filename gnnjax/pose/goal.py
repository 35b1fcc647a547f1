"""What a query may ask for in place of a configuration: a pose of the hand."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.parts import quat_to_matrix
from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief, is_list
from gnnjax.scene.allowed import last_link

AXES = ("x", "y", "z", "rx", "ry", "rz")
_TOOL = "tool"  # a site of that name is what poses are of
_MOST_METERS = 1e4
_LENGTH_ERROR = 0.01  # how far from 1 the length of a quaternion may be


class PoseGoal(NamedTuple):
    """Where a frame of the arm should be, in the frame of the arm's base."""

    position: ArrayLike  # [*batch 3] m
    quat: ArrayLike  # [*batch 4] w x y z, frame to base
    # Of `AXES`, those of the pose itself along which (x y z) the place does not count, and about
    # which (rx ry rz) the turn does not: one of the latter, or all.
    free: Sequence[str] = ()
    tolerance: tuple[float, float] = (1e-4, 1e-3)  # m, rad: what is farther off has not reached it
    frame: str | None = None  # site or body of the arm; see `tool_frame`


class ToolFrame(NamedTuple):
    """A frame that is fixed to a body of the arm."""

    name: str
    chain: tuple[int, ...]  # indices of bodies, from the base to the one that it is fixed to
    position: np.ndarray  # [3] m, in that body's frame
    rotation: np.ndarray  # [3 3]


def tool_frame(robot: Robot, name: str | None = None) -> ToolFrame:
    """The frame of a site or body; by default of the site "tool", or where there is none, of the
    last body, but for what the arm holds.

    Raises:
        InputError: no site or body has the name, or no joint moves it.
    """
    model = robot.mj_model
    sites = [model.site(s).name for s in range(model.nsite)]
    bodies = [body.name for body in robot.bodies]
    if name is None:
        name = _TOOL if _TOOL in sites else None
    if name in sites:
        site = sites.index(name)
        body = int(model.site_bodyid[site]) - 1
        place = model.site_pos[site].copy(), quat_to_matrix(model.site_quat[site])
    elif name is None or name in bodies:
        body = last_link(robot) if name is None else bodies.index(name)
        place = np.zeros(3), np.eye(3)
    else:
        known = [x for x in (*sites, *bodies) if x]
        raise InputError(f"no site or body {name!r} in {robot.name}; there are {known}")
    chain: list[int] = []
    while body >= 0:
        chain.insert(0, body)
        body = robot.bodies[body].parent
    if not any(robot.bodies[b].joints for b in chain):
        raise InputError(f"{name!r} of {robot.name} is moved by no joint; choose another frame")
    return ToolFrame(name or bodies[chain[-1]] or "the last body", tuple(chain), *place)


def check_goal(goal: PoseGoal) -> tuple[np.ndarray, np.ndarray]:
    """Positions `[*batch 3]` and unit quaternions `[*batch 4]` in double precision, or what is
    wrong with a goal.

    Raises:
        InputError: names the value.
    """
    if not isinstance(goal, PoseGoal):
        raise InputError(f"the pose is {brief(goal)}; give a PoseGoal(position, quat)")
    try:
        position, quat = np.asarray(goal.position, float), np.asarray(goal.quat, float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"the pose {brief((goal.position, goal.quat))} is not made of numbers; give a position "
            "of 3 (m) and a quaternion of 4 (w x y z)"
        ) from None
    shape = position.shape[:-1]
    if position.shape[-1:] != (3,) or quat.shape != (*shape, 4) or 0 in shape:
        raise InputError(
            f"the pose has a position of shape {position.shape} and a quaternion of shape "
            f"{quat.shape}; give 3 numbers (m) and 4 (w x y z)"
        )
    _refuse("position", position, np.abs(position) <= _MOST_METERS, "finite, in m")
    length = np.linalg.norm(quat, axis=-1, keepdims=True)
    near = np.abs(length - 1) <= _LENGTH_ERROR
    _refuse("quaternion", quat, near, "of length 1, as w x y z")
    free = list(goal.free) if is_list(goal.free) else [goal.free]
    if not is_list(goal.free) or any(axis not in AXES for axis in free):
        raise InputError(f"the pose has free axes {brief(goal.free)}; give a list of {list(AXES)}")
    if not isinstance(goal.frame, str | None):
        raise InputError(f"the frame is {brief(goal.frame)}; give the name of a site or body")
    turns = [axis for axis in AXES[3:] if axis in free]
    if len(turns) == 2:
        raise InputError(f"the pose has {turns} free; give one axis of turns, or all three")
    if len(set(free)) == len(AXES):
        raise InputError("the pose has all axes free, and asks for nothing; leave one out")
    try:
        most = np.asarray(goal.tolerance, float)
    except (TypeError, ValueError, OverflowError):
        most = np.zeros(0)
    if most.shape != (2,) or not (most > 0).all():
        raise InputError(f"the tolerance is {brief(goal.tolerance)}; give m and rad, both above 0")
    return position, quat / length


def _refuse(name: str, values: np.ndarray, good: np.ndarray, rule: str) -> None:
    """Refuses values `[*batch n]` that do not keep a rule; NaN keeps none."""
    bad = ~good.all(axis=-1)
    if bad.any():
        value = values.reshape(-1, values.shape[-1])[bad.reshape(-1).argmax()].tolist()
        raise InputError(f"the pose has the {name} {value}; it must be {rule}")
