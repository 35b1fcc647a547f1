"""Forward kinematics as straight-line code, generated from a robot's constants.

The functions work on components: a configuration is a list of D arrays, a point a list of three, a
rotation nine, each array holding that one component for a whole batch. Every operation is then
elementwise over the batch, which the compiler turns into vector instructions, and the zeros and
ones of the MJCF frames vanish while the code is generated. On a CPU this is ten times faster than
batches of 3 x 3 matrix products.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gnnjax.arm.robot import Body, Joint, Robot

Scalar: TypeAlias = float | jax.Array  # one component: a constant, or an array over the batch
Vector: TypeAlias = list[Scalar]  # 3 components
Matrix: TypeAlias = list[list[Scalar]]  # 3 rows of 3 components
Frame: TypeAlias = tuple[Vector, Matrix]  # position [m] and rotation

WORLD: Frame = ([0.0, 0.0, 0.0], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


class Joints(NamedTuple):
    """Joint values for a batch, with what the frames need of them."""

    values: Float[Array, "D ..."]  # from the pose in which the MJCF places the bodies, rad or m
    cos: Float[Array, "D ..."]
    sin: Float[Array, "D ..."]


def joint_terms(robot: Robot, q: Float[Array, "*batch D"]) -> Joints:
    """Prepares configurations for `body_frames`.

    Apart from it because cosines and sines cost as much as the rest of the kinematics; code that
    computes frames again and again should not also compute those again.
    """
    # MuJoCo's bodies lie as the MJCF places them when a joint is at its reference (`ref`).
    values = jnp.moveaxis(q - jnp.asarray(robot.mj_model.qpos0, q.dtype), -1, 0)
    return Joints(values, jnp.cos(values), jnp.sin(values))


def multiply(a: Scalar, b: Scalar) -> Scalar:
    """a * b, generating no code for constants zero and one."""
    if isinstance(a, float):
        a, b = b, a
    if isinstance(b, float):
        if b == 0.0:
            return 0.0
        if b == 1.0:
            return a
        if b == -1.0:
            return -a
    return a * b


def add(a: Scalar, b: Scalar) -> Scalar:
    """a + b, generating no code for a constant zero."""
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    return a + b


def dot(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    """Inner product of component lists."""
    total: Scalar = 0.0
    for x, y in zip(a, b, strict=True):
        total = add(total, multiply(x, y))
    return total


def subtract(a: Vector, b: Vector) -> Vector:
    """a - b by component."""
    return [add(x, multiply(y, -1.0)) for x, y in zip(a, b, strict=True)]


def transform(position: Vector, rotation: Matrix, point: Vector) -> Vector:
    """A point of a frame, where the frame is seen from."""
    return [add(p, dot(row, point)) for p, row in zip(position, rotation, strict=True)]


def product(a: Matrix, b: Matrix) -> Matrix:
    """Matrix product by component."""
    columns = list(zip(*b, strict=True))
    return [[dot(row, column) for column in columns] for row in a]


def _constant(array: np.ndarray) -> list:
    return array.astype(float).tolist()


def _align_z(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes the z axis to `axis`."""
    if np.allclose(axis, [0.0, 0.0, 1.0]):
        return np.eye(3)
    other = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(other, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def body_frames(
    robot: Robot,
    joints: Joints,
    base: Frame = WORLD,
    settle: Callable[[Frame], Frame] = lambda frame: frame,
) -> list[Frame]:
    """Position and rotation of every body.

    Args:
        robot: the arm whose constants go into the code.
        joints: from `joint_terms`.
        base: the world, seen from the frame in which the bodies are wanted.
        settle: applied to each body's frame before those that hang on it are computed.
    """
    frames: list[Frame] = []
    for body in robot.bodies:
        position, rotation = frames[body.parent] if body.parent >= 0 else base
        frames.append(settle(_move(body, position, rotation, joints)))
    return frames


def _move(body: Body, position: Vector, rotation: Matrix, joints: Joints) -> Frame:
    position = transform(position, rotation, _constant(body.position))
    rotation = product(rotation, _constant(body.rotation))
    for joint in body.joints:
        position, rotation = move_joint(joint, position, rotation, joints)
    return position, rotation


def move_joint(joint: Joint, position: Vector, rotation: Matrix, joints: Joints) -> Frame:
    """The frame of a body behind one of its joints, of the frame before it."""
    if not joint.hinge:
        direction = [dot(row, _constant(joint.axis)) for row in rotation]
        value = joints.values[joint.index]
        return [
            add(p, multiply(d, value)) for p, d in zip(position, direction, strict=True)
        ], rotation
    cos, sin = joints.cos[joint.index], joints.sin[joint.index]
    turn: Matrix = [[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]
    align = _align_z(joint.axis)
    anchor = transform(position, rotation, _constant(joint.anchor))
    rotation = product(rotation, _constant(align))
    rotation = product(product(rotation, turn), _constant(align.T))
    # The anchor is the point of the body that the turn leaves where it was.
    return subtract(anchor, [dot(row, _constant(joint.anchor)) for row in rotation]), rotation


def frame_arrays(robot: Robot, q: Float[Array, "N D"]) -> Float[Array, "L 3 4 N"]:
    """Rotation and position [m] of every body and, last, of the world, as one array.

    For few configurations: the components of `body_frames` are faster where all of a pass is fused
    into one loop, but written to memory each of them is a loop of its own, 12 a body, each of which
    takes its time to compile and to call. Here a body is one loop.
    """
    values, cos, sin = joint_terms(robot, q)
    moves = _moves(robot)
    index = np.array([move.joint for move in moves])
    fixed, with_cos, with_sin, with_value = (
        jnp.asarray(np.stack(x), q.dtype)[..., None]
        for x in zip(*(move[3:] for move in moves), strict=True)
    )

    def of_joints(terms: jax.Array) -> jax.Array:
        return terms[index][:, None, None]

    local = fixed + with_cos * of_joints(cos) + with_sin * of_joints(sin)
    local += with_value * of_joints(values)
    frames: list[jax.Array] = []
    for move, each in zip(moves, local, strict=True):
        frame = each
        if move.parent >= 0:
            before = frames[move.parent]
            frame = jnp.sum(before[:, :3, None] * each[None], axis=1)
            frame += jnp.pad(before[:, 3:], ((0, 0), (3, 0), (0, 0)))
        # Written to memory, or every number would be computed from the base on.
        frames.append(jax.lax.optimization_barrier(frame))
    last = {}
    for number, move in enumerate(moves):
        last[move.body] = frames[number]
    world = jnp.broadcast_to(jnp.eye(3, 4, dtype=q.dtype)[..., None], (3, 4, len(q)))
    return jnp.stack([*(last[b] for b in range(len(robot.bodies))), world])


class _Move(NamedTuple):
    """A frame `[3 4]` behind a body's placement and one of its joints, seen from an earlier one."""

    body: int
    parent: int  # of the moves; -1: the world
    joint: int  # whose cosine, sine and value count
    fixed: np.ndarray
    with_cos: np.ndarray
    with_sin: np.ndarray
    with_value: np.ndarray


def _moves(robot: Robot) -> list[_Move]:
    moves: list[_Move] = []
    last: list[int] = []  # move of each body
    none = np.zeros((3, 4))
    for number, body in enumerate(robot.bodies):
        parent = last[body.parent] if body.parent >= 0 else -1
        placed = np.column_stack([body.rotation, body.position])
        if not body.joints:
            moves.append(_Move(number, parent, 0, placed, none, none, none))
        for joint in body.joints:
            parts = [np.eye(3, 4), none, none, none]
            if joint.hinge:  # Rodrigues' formula, about an axis through the anchor
                x, y, z = joint.axis
                along = np.outer(joint.axis, joint.axis)
                turns = along, np.eye(3) - along, np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
                parts[:3] = [np.column_stack([t, -t @ joint.anchor]) for t in turns]
                parts[0][:, 3] += joint.anchor
            else:
                parts[3] = np.column_stack([np.zeros((3, 3)), joint.axis])
            seen = [placed[:, :3] @ part for part in parts]
            seen[0][:, 3] += placed[:, 3]
            moves.append(_Move(number, parent, joint.index, *seen))
            parent, placed = len(moves) - 1, np.eye(3, 4)
        last.append(len(moves) - 1)
    return moves


def forward_kinematics(
    robot: Robot, q: Float[Array, "*batch D"]
) -> tuple[Float[Array, "*batch L 3"], Float[Array, "*batch L 3 3"]]:
    """Positions [m] and rotations of the robot's L bodies, in the order of `robot.bodies`.

    Seen from the base of the arm, like scenes.
    """
    frames = jnp.moveaxis(frame_arrays(robot, q.reshape(-1, q.shape[-1]))[:-1], -1, 0)
    frames = frames.reshape(*q.shape[:-1], *frames.shape[1:])
    return frames[..., 3], frames[..., :3]
