"""Bodies of an arm and their joints, as MuJoCo's model has them."""

from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.parts import quat_to_matrix

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


class Joint(NamedTuple):
    """One hinge or slide joint of a body, in the body's frame."""

    index: int  # position in the configuration
    hinge: bool  # false: slide
    axis: np.ndarray  # [3] unit vector
    anchor: np.ndarray  # [3] m, the point the axis goes through


class Body(NamedTuple):
    """One link: how its frame lies in its parent's, and the joints that move it."""

    name: str
    parent: int  # index into `Robot.bodies`, -1 for the world
    position: np.ndarray  # [3] m
    rotation: np.ndarray  # [3 3]
    joints: tuple[Joint, ...]


def read_body(model: mujoco.MjModel, b: int) -> Body:
    """Body b of a model, which has no number 0, its world."""
    first, count = model.body_jntadr[b], model.body_jntnum[b]
    joints = tuple(
        Joint(
            index=int(j),
            hinge=int(model.jnt_type[j]) == _HINGE,
            axis=model.jnt_axis[j].copy(),
            anchor=model.jnt_pos[j].copy(),
        )
        for j in range(first, first + count)
    )
    return Body(
        name=model.body(b).name,
        parent=int(model.body_parentid[b]) - 1,
        position=model.body_pos[b].copy(),
        rotation=quat_to_matrix(model.body_quat[b]),
        joints=joints,
    )
