"""Distances of points, segments and boxes, on lists of components (see `kinematics.py`).

Everything is elementwise over the batch. Comparisons are written as `where` because the compiler
turns that into a single vector instruction, where `maximum` must also carry NaN.
"""

import jax
import jax.numpy as jnp

from gnnjax.arm.kinematics import Scalar, Vector, add, dot, subtract


def segment_box_squared(center: Vector, axis: Vector | None, half_extents: Vector) -> jax.Array:
    """Squared distance of a segment, given in the box's frame, to the box; 0 inside.

    Args:
        center: middle of the segment, m, the box's centre being the origin.
        axis: from the middle to one end, m; None for a point.
        half_extents: of the box, m.
    """
    point = center
    if axis is not None:
        t = _nearest_parameter(center, axis, half_extents)
        point = [add(c, t * a) for c, a in zip(center, axis, strict=True)]
    outside = [_excess(x, h) for x, h in zip(point, half_extents, strict=True)]
    return jnp.asarray(dot(outside, outside))


def _excess(x: Scalar, h: Scalar) -> jax.Array:
    """How far |x| exceeds h."""
    beyond = jnp.abs(x) - h
    return jnp.where(beyond > 0.0, beyond, 0.0)


def _nearest_parameter(center: Vector, axis: Vector, half_extents: Vector) -> jax.Array:
    """Where on center + t axis, t in [-1, 1], the box is nearest.

    The squared distance is convex and piecewise quadratic in t, so its slope is increasing and
    piecewise linear, with kinks where the segment crosses a face's plane. Evaluated at the kinks
    and the ends, the slope's zero is between two of them, and linear there.
    """

    def slope(t):
        terms = []
        for c, a, h in zip(center, axis, half_extents, strict=True):
            x = c + t * a
            terms.append(jnp.sign(x) * _excess(x, h) * a)
        return sum(terms)

    kinks = [jnp.float32(-1.0), jnp.float32(1.0)]
    for c, a, h in zip(center, axis, half_extents, strict=True):
        steady = jnp.where(jnp.abs(a) < 1e-9, 1e-9, a)  # parallel to the face: the kink is far away
        kinks += [jnp.clip((side * h - c) / steady, -1.0, 1.0) for side in (-1.0, 1.0)]
    low, low_slope = kinks[0], slope(kinks[0])
    high, high_slope = kinks[1], slope(kinks[1])
    for t in kinks[2:]:
        value = slope(t)
        raise_low, drop_high = (value <= 0.0) & (t > low), (value >= 0.0) & (t < high)
        low, low_slope = jnp.where(raise_low, t, low), jnp.where(raise_low, value, low_slope)
        high, high_slope = jnp.where(drop_high, t, high), jnp.where(drop_high, value, high_slope)
    rise = high_slope - low_slope
    between = low - low_slope * (high - low) / jnp.where(rise > 0.0, rise, 1.0)
    # Slopes of one sign: the nearest point is an end.
    inner = jnp.where(rise > 0.0, between, low)
    return jnp.where(low_slope >= 0.0, low, jnp.where(high_slope <= 0.0, high, inner))


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
