"""Distances of points, segments and obstacles, on lists of components (see `kinematics.py`).

Everything is elementwise over the batch. Comparisons are written as `where` because the compiler
turns that into a single vector instruction, where `maximum` must also carry NaN.
"""

import jax
import jax.numpy as jnp

from gnnjax.arm.kinematics import Scalar, Vector, add, dot, subtract

_HALVINGS = 12  # of a segment, to find where it is nearest to an obstacle


def segment_sum_squared(
    center: Vector, axis: Vector | None, half_extents: Vector, disc: Scalar
) -> jax.Array:
    """Squared distance of a segment, given in an obstacle's frame, to its box and disc; 0 inside.

    Args:
        center: middle of the segment, m, the obstacle's centre being the origin.
        axis: from the middle to one end, m; None for a point.
        half_extents: of the box, m.
        disc: radius of the disc about z by which the box is widened, m.
    """
    point = center
    if axis is not None:
        t = _nearest_parameter(center, axis, half_extents, disc)
        point = [add(c, t * a) for c, a in zip(center, axis, strict=True)]
    x, y, z = (_excess(p, h) for p, h in zip(point, half_extents, strict=True))
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


def _excess(x: Scalar, h: Scalar) -> jax.Array:
    """How far |x| exceeds h."""
    return _positive(jnp.abs(x) - h)


def _nearest_parameter(
    center: Vector, axis: Vector, half_extents: Vector, disc: Scalar
) -> jax.Array:
    """Where on center + t axis, t in [-1, 1], the obstacle is nearest.

    The squared distance is convex in t, so that its slope has one zero, or one stretch of them:
    halved until it is a 2,000th of the segment long, from somewhat beyond the ends. There the
    distance is at most that off, and less where it is large, since it is flat at its least.
    """
    slope = jnp.zeros(jnp.broadcast_shapes(*(jnp.shape(x) for x in (*center, *axis, disc))))
    low, high = slope - 1.001, slope + 1.001

    def halve(_, ends):
        low, high = ends
        t = 0.5 * (low + high)
        along = [add(c, t * a) for c, a in zip(center, axis, strict=True)]
        x, y, z = (jnp.sign(p) * _excess(p, h) for p, h in zip(along, half_extents, strict=True))
        apart = jnp.sqrt(x * x + y * y)
        beside = _positive(apart - disc) / jnp.where(apart > 0.0, apart, 1.0)
        rising = beside * (x * axis[0] + y * axis[1]) + z * axis[2] > 0.0
        return jnp.where(rising, low, t), jnp.where(rising, t, high)

    for step in range(_HALVINGS):
        low, high = halve(step, (low, high))
    return jnp.clip(0.5 * (low + high), -1.0, 1.0)


def segment_segment_squared(
    center_a: Vector, axis_a: Vector | None, center_b: Vector, axis_b: Vector | None
) -> jax.Array:
    """Squared distance of two segments center + t axis, t in [-1, 1]; axis None for points.

    Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    offset = subtract(center_a, center_b)
    if axis_a is not None and axis_b is not None:
        aa, bb, ab = dot(axis_a, axis_a), dot(axis_b, axis_b), dot(axis_a, axis_b)
        oa, ob = dot(offset, axis_a), dot(offset, axis_b)
        det = aa * bb - ab * ab
        free = jnp.clip((ab * ob - oa * bb) / jnp.where(det > 1e-12, det, 1.0), -1.0, 1.0)
        s = jnp.where(det > 1e-12, free, 0.0)
        t = jnp.clip((ab * s + ob) / bb, -1.0, 1.0)
        s = jnp.clip((ab * t - oa) / aa, -1.0, 1.0)
        offset = [o + s * a - t * b for o, a, b in zip(offset, axis_a, axis_b, strict=True)]
    elif axis_a is not None:
        s = jnp.clip(-dot(offset, axis_a) / dot(axis_a, axis_a), -1.0, 1.0)
        offset = [o + s * a for o, a in zip(offset, axis_a, strict=True)]
    elif axis_b is not None:
        t = jnp.clip(dot(offset, axis_b) / dot(axis_b, axis_b), -1.0, 1.0)
        offset = [o - t * b for o, b in zip(offset, axis_b, strict=True)]
    return jnp.asarray(dot(offset, offset))
