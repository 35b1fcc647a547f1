"""Where obstacles stand: rigid motions, and obstacles as another frame sees them."""

from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.scene.shapes import IDENTITY_QUAT, Shape, for_every_kind


class Pose(NamedTuple):
    """A frame as another one sees it."""

    position: np.ndarray  # [3] m
    quat: np.ndarray  # [4] unit quaternion w x y z


IDENTITY = Pose(np.zeros(3), np.array(IDENTITY_QUAT))


def compose(outer: Pose, inner: Pose) -> Pose:
    """The pose, in the frame that `outer` is given in, of what `outer`'s frame sees at `inner`."""
    found = Pose(np.zeros(3), np.zeros(4))
    mujoco.mju_mulPose(*found, *outer, *inner)
    return found


def inverse(pose: Pose) -> Pose:
    """The frame that `pose` is given in, as `pose`'s frame sees it."""
    found = Pose(np.zeros(3), np.zeros(4))
    mujoco.mju_negPose(*found, *pose)
    return found


def _point(pose: Pose, point: np.ndarray) -> np.ndarray:
    return compose(pose, Pose(point, IDENTITY.quat)).position


def _direction(pose: Pose, direction: np.ndarray) -> np.ndarray:
    found = np.zeros(3)
    mujoco.mju_rotVecQuat(found, direction, pose.quat)
    return found


def _turned(pose: Pose, quat: np.ndarray) -> np.ndarray:
    return compose(pose, Pose(np.zeros(3), quat)).quat


def moved_points(points: np.ndarray, pose: Pose) -> np.ndarray:
    """Points `[K, 3]` given in `pose`'s frame, as the frame sees them that `pose` is given in."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, pose.quat)
    return points @ rotation.reshape(3, 3).T + pose.position


_PLACED = {"center": _point, "quat": _turned}
# What of an obstacle depends on the frame, and how.
_MOVES = for_every_kind(
    "change of frame",
    box=_PLACED,
    sphere={"center": _point},
    capsule=_PLACED,
    cylinder=_PLACED,
    half_space={"point": _point, "normal": _direction},
)


def moved(shape: Shape, pose: Pose) -> Shape:
    """An obstacle given in `pose`'s frame, as the frame sees it that `pose` is given in."""
    values = {name: np.asarray(value, float) for name, value in shape.values.items()}
    changed = {name: move(pose, values[name]) for name, move in _MOVES[shape.kind].items()}
    return Shape(shape.kind, {**shape.values, **changed})
