"""Transforms `[3 4]`: a rotation and, in the last column, a place, m.

What joints do to the bodies behind them, as whole transforms. Few configurations cost less this way
than by the components of `kinematics.py`, each of which is an operation of its own.
"""

import jax
import numpy as np

from gnnjax.arm.bodies import Joint


def transform_of(rotation: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Of a rotation `[3 3]` and a place `[3]`."""
    return np.concatenate([rotation, place[:, None]], axis=1)


def compose(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """What `inner` is where `outer` is seen from."""
    moved = outer[:, :3] @ inner
    moved[:, 3] += outer[:, 3]
    return moved


def compose_each(outer: jax.Array, inner: jax.Array) -> jax.Array:
    """`compose` of S transforms `[3 4 S]`."""
    # No reduction and no update in place, each of which the compiler would make a loop of its own.
    turned = sum(outer[:, k, None] * inner[k] for k in range(3))
    return turned + outer[:, 3:] * np.eye(4, dtype=outer.dtype)[3, :, None]


def behind(before: np.ndarray, joint: Joint | None) -> np.ndarray:
    """What lies behind a joint of a body, in the frame that the body is in: `[4 3 4]`, the first
    plus the others times cosine and sine of a hinge, and the value of a slide.

    Args:
        before: of the body.
        joint: None for none, which moves nothing.
    """
    still, *moving = _parts(joint)
    return np.stack([compose(before, still), *(before[:, :3] @ x for x in moving)])


def _parts(joint: Joint | None) -> np.ndarray:
    """`behind` in the body's own frame."""
    nothing = np.zeros((3, 4))
    if joint is None or not joint.hinge:
        along = np.zeros(3) if joint is None else joint.axis
        parts = nothing, nothing, transform_of(np.zeros((3, 3)), along)
        return np.stack([transform_of(np.eye(3), np.zeros(3)), *parts])
    x, y, z = joint.axis
    along = np.outer(joint.axis, joint.axis)
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # Rodrigues' formula
    turns = [along, np.eye(3) - along, across]
    # The anchor stays where it is.
    parts = [transform_of(turn, -turn @ joint.anchor) for turn in turns]
    parts[0][:, 3] += joint.anchor
    return np.stack([*parts, nothing])
