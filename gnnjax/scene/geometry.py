"""Distances of points and obstacles, on lists of components (see `kinematics.py`).

Everything is elementwise over the batch. Comparisons are written as `where` because the compiler
turns that into a single vector instruction, where `maximum` must also carry NaN.
"""

import jax
import jax.numpy as jnp

from gnnjax.arm.kinematics import Scalar, Vector


def squared_distance(point: Vector, half_extents: Vector, disc: Scalar) -> jax.Array:
    """Squared distance of a point, given in an obstacle's frame, to its box and disc; 0 inside.

    Args:
        point: m, the obstacle's centre being the origin.
        half_extents: of the box, m.
        disc: radius of the disc about z by which the box is widened, m.
    """
    x, y, z = (_positive(jnp.abs(p) - h) for p, h in zip(point, half_extents, strict=True))
    beside = _positive(jnp.sqrt(x * x + y * y) - disc)
    return beside * beside + z * z


def signed_distance(point: Vector, half_extents: Vector, disc: Scalar, ball: Scalar) -> jax.Array:
    """Distance of a point, given in an obstacle's frame, to the obstacle; negative inside."""
    x, y, z = (jnp.abs(p) - h for p, h in zip(point, half_extents, strict=True))
    apart = jnp.sqrt(_positive(x) ** 2 + _positive(y) ** 2)
    beside = jnp.where(apart > 0.0, apart, jnp.where(x > y, x, y)) - disc
    outside = jnp.sqrt(_positive(beside) ** 2 + _positive(z) ** 2)
    inside = jnp.where(beside > z, beside, z)
    return outside + jnp.where(inside < 0.0, inside, 0.0) - ball


def _positive(x: jax.Array) -> jax.Array:
    return jnp.where(x > 0.0, x, 0.0)
