"""How far parts of an arm are, at most, from the axes of the joints that move them.

A part swings about an axis on circles, at most as large as the sum of the links between them. A
joint that moves two parts against each other swings the one about the other, or the other way
round: to their distance it is the same. So the part that comes less far from its axis bounds how
fast the distance changes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.bodies import Body
from gnnjax.arm.robot import Robot


class Line(NamedTuple):
    """The axis of a joint, wherever the arm is."""

    joint: int
    hinge: bool
    axis: np.ndarray  # [3]
    anchor: np.ndarray  # [3] m, a point that it goes through
    travel: float  # m, of a slide, how far it takes what is behind it


def reach_along(points: np.ndarray, lines: Sequence[Line]) -> np.ndarray:
    """Bounds `[N, K]` on how far joints move points `[N, 3]` by a unit of each, m/rad or m/m.

    Args:
        points: of a part, where the arm is.
        lines: of joints, in their order from the part on.
    """
    found, beyond, last = np.ones((len(points), len(lines))), np.zeros(len(points)), None
    for number, line in enumerate(lines):
        if last is None:
            offset = points - line.anchor
            # What lies along the axis does not count.
            radial = np.linalg.norm(np.cross(line.axis, offset), axis=1)
            beyond = np.linalg.norm(offset, axis=1)
        else:
            radial = beyond = beyond + np.linalg.norm(line.anchor - last)
        if line.hinge:
            found[:, number] = radial
        beyond, last = beyond + line.travel, line.anchor
    return found


def reach_between(
    ends: Sequence[np.ndarray], lines: Sequence[Line]
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Joints, and what bounds how far they move points of either end, by the other, `[N, K]`.

    Args:
        ends: points `[N, 3]` of two parts.
        lines: of the joints between them, from the first on.
    """
    one, other = reach_along(ends[0], lines), reach_along(ends[1], lines[::-1])
    return [line.joint for line in lines], one, other[:, ::-1]


def ways_apart(bodies: Sequence[Body], first: int, second: int) -> tuple[list[int], list[int]]:
    """The bodies from the last one that carries two, without it, to either."""

    def to_base(body: int) -> list[int]:
        return [] if body < 0 else [*to_base(bodies[body].parent), body]

    one, other = to_base(first), to_base(second)
    shared = sum(a == b for a, b in zip(one, other, strict=False))
    return one[shared:], other[shared:]


class AtHome:
    """An arm at home: places of its parts, and the lines of its joints."""

    def __init__(self, robot: Robot):
        self._robot, self._data = robot, mujoco.MjData(robot.mj_model)
        self._data.qpos[:] = robot.home
        mujoco.mj_kinematics(robot.mj_model, self._data)

    def placed(self, body: int, points: np.ndarray) -> np.ndarray:
        """Points `[N, 3]` of a body, or of the world, -1, in the world."""
        data = self._data
        return points @ data.xmat[body + 1].reshape(3, 3).T + data.xpos[body + 1]

    def lines(self, first: int, second: int) -> list[Line]:
        """Of the joints that move two bodies against each other, from the first to the second."""
        bodies = self._robot.bodies
        ways = ways_apart(bodies, first, second)
        up, down = ([joint for b in way for joint in bodies[b].joints] for way in ways)
        return [
            Line(
                joint.index,
                joint.hinge,
                self._data.xaxis[joint.index].copy(),
                self._data.xanchor[joint.index].copy(),
                0.0 if joint.hinge else float(self._robot.joint_range[joint.index]),
            )
            for joint in [*up[::-1], *down]
        ]
