"""The joints that move a frame of the arm: a transform each, affine in its cosine and sine.

Kinematics of one frame alone, for S configurations, which come last in arrays; what joints have in
common is computed together. Transforms are those of `arm/transforms.py`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.arm.bodies import Joint
from gnnjax.arm.robot import Robot
from gnnjax.arm.transforms import behind, compose, compose_each, transform_of
from gnnjax.pose.goal import ToolFrame


class Chain(NamedTuple):
    """N joints, the base's first, and the frame behind them."""

    joints: np.ndarray  # [N] positions in the configuration
    hinge: np.ndarray  # [N] false: slide
    zero: np.ndarray  # [N] rad or m, where the file puts its bodies
    # [4 N 3 4] a joint's frame in the one before it: the first, plus the others times cosine and
    # sine of a hinge, and the value of a slide.
    parts: np.ndarray
    axes: np.ndarray  # [N 3] in the joint's own frame, as are
    anchors: np.ndarray  # [N 3] m
    tool: np.ndarray  # [3 4] the frame, in the last joint's


class Kinematics(NamedTuple):
    """Where a frame is, and how joints move it."""

    frame: jax.Array  # [3 4 S]
    jacobian: jax.Array  # [D 6 S] m and rad a rad or m


def chain_of(robot: Robot, tool: ToolFrame) -> Chain:
    """The joints between the base and a frame."""
    joints: list[Joint] = []
    parts: list[np.ndarray] = []
    before = nowhere = transform_of(np.eye(3), np.zeros(3))
    for b in tool.chain:
        body = robot.bodies[b]
        before = compose(before, transform_of(body.rotation, body.position))
        for joint in body.joints:
            parts.append(behind(before, joint))
            before = nowhere
            joints.append(joint)
    numbers = np.array([joint.index for joint in joints])
    return Chain(
        joints=numbers,
        hinge=np.array([joint.hinge for joint in joints]),
        zero=robot.mj_model.qpos0[numbers],
        parts=np.stack(parts, axis=1),
        axes=np.stack([joint.axis for joint in joints]),
        anchors=np.stack([joint.anchor for joint in joints]),
        tool=compose(before, transform_of(tool.rotation, tool.position)),
    )


def kinematics(chain: Chain, base: jax.Array, q: jax.Array) -> Kinematics:
    """The frame of a chain, and its derivatives.

    Args:
        chain: its constants.
        base: `[3 4 S]`, the arm's base, in the frame in which all is wanted.
        q: `[D S]` configurations.
    """

    def constant(array: np.ndarray) -> jax.Array:
        return jnp.asarray(array, q.dtype)[..., None]

    values = q[chain.joints] - constant(chain.zero)
    hinge = constant(chain.hinge)
    factors = jnp.stack([jnp.cos(values) * hinge, jnp.sin(values) * hinge, values * (1 - hinge)])
    still, moving = constant(chain.parts[0]), constant(chain.parts[1:])
    local = materialized(still + jnp.sum(moving * factors[:, :, None, None], axis=0))
    frames = []
    for one in local:
        base = materialized(compose_each(base, one))
        frames.append(base)
    found = jnp.stack(frames)  # [N 3 4 S]
    frame = compose_each(base, constant(chain.tool))
    axes = jnp.sum(found[:, :, :3] * constant(chain.axes)[:, None], axis=2)
    anchors = found[:, :, 3] + jnp.sum(found[:, :, :3] * constant(chain.anchors)[:, None], axis=2)
    around = jnp.cross(axes, frame[:, 3] - anchors, axis=1)
    columns = jnp.concatenate(
        [jnp.where(hinge[:, None] > 0, around, axes), axes * hinge[:, None]], axis=1
    )
    jacobian = jnp.zeros((len(q), *columns.shape[1:]), q.dtype).at[chain.joints].set(columns)
    return Kinematics(frame, jacobian)


def materialized(values: jax.Array) -> jax.Array:
    """Written to memory, or the compiler computes it anew wherever it is used."""
    return jax.lax.optimization_barrier(values)
