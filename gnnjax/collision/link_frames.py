"""Kinematics of the certificate, in NumPy and double precision, apart from the planning kernels.

Arrays have their components first and what they are computed for last, see `obstacles.py`.
"""

import numpy as np

from gnnjax.collision.bounds import Spheres


def link_frames(body: Spheres, q: np.ndarray) -> np.ndarray:
    """The axes and the origin of every link at q `[D, B]`, `[4, 3, L, B]`."""
    # Bodies lie as the MJCF places them when a joint is at its reference (`ref`).
    value = q - body.robot.mj_model.qpos0[:, None]
    sin, cos = np.sin(value)[:, None, None], np.cos(value)[:, None, None]
    # Rodrigues, [D 3 3 B].
    cross, squared = body.crosses[..., None], (body.crosses @ body.crosses)[..., None]
    turns = np.eye(3)[..., None] + cross * sin + squared * (1 - cos)
    world = np.concatenate([np.eye(3), np.zeros((1, 3))])[..., None]
    # The world comes first here: indices are shifted by one.
    frames = [np.broadcast_to(world, (4, 3, q.shape[1]))]
    for link in body.robot.bodies:
        parent = frames[link.parent + 1]
        origin = place(parent, link.position)
        axes = _turned(parent, link.rotation[..., None])
        for joint in link.joints:
            if not joint.hinge:
                origin = origin + _along(axes, joint.axis) * value[joint.index]
                continue
            turned = _turned(axes, turns[joint.index])
            if joint.anchor.any():
                origin = origin + _along(axes, joint.anchor) - _along(turned, joint.anchor)
            axes = turned
        frames.append(np.concatenate([axes, origin[None]]))
    return np.stack([frames[number + 1] for number in body.links], axis=2)


def _along(axes: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Points `[3, ...]`, given by components `[3, ...]` along axes `[3, 3, ...]`."""
    return axes[0] * point[0] + axes[1] * point[1] + axes[2] * point[2]


def place(frames: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Points in the world, of points in frames `[4, 3, ...]`."""
    return frames[3] + _along(frames, point)


def _turned(axes: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Axes `[3, 3, B]`, turned by rotations `[3, 3, B]` as seen along themselves."""
    return _along(axes[:, None], turn[:, :, None])
