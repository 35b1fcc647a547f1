"""Where the hull of a few points is nearest to the origin, on lists of components."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from gnnjax.arm.kinematics import Vector, dot, subtract

_FLAT = 1e-10  # squared sine between edges of a triangle that is taken for a line
_DEEP = 1e-12  # m^2; the origin is inside if it lies so far, squared, behind each face
_INSIDE = 6  # the feature of four points that is none of the edges and faces at one of them


def nearest_point(
    new: Vector, old: list[Vector], turns: jax.Array
) -> tuple[Vector, list[Vector], jax.Array]:
    """The point nearest to the origin in the hull of a new point and three old ones.

    Only the edges and faces at the new point are looked at: without it the nearest point is known,
    and the new one lies beyond. Points that fall together make edges without length and faces
    without area, which are the nearest of nothing.

    Args:
        new: lies farthest in the direction from the old ones' nearest point to the origin.
        old: three points, which may be the same.
        turns: one, in a way that the compiler cannot see; see `_once`.

    Returns:
        the nearest point; three points in whose hull it is; whether the origin is in that of all.
    """
    chosen = _once(_nearest_feature, turns, new, old)
    first: Vector = [_choose(chosen, [*x, *x, x[0]]) for x in zip(*old, strict=True)]
    second: Vector = [_choose(chosen, [*x, *x[1:], *x[:2]]) for x in zip(*old, strict=True)]
    e, f = subtract(first, new), subtract(second, new)
    normal = _cross(e, f)
    height = dot(normal, new) / dot(normal, normal)
    t = _along(new, e)
    nearest: Vector = [
        jnp.where(chosen < 3, x + t * y, height * z) for x, y, z in zip(new, e, normal, strict=True)
    ]
    return nearest, [new, first, second], chosen == _INSIDE


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]


def _choose(index: jax.Array, options: list[jax.Array]) -> jax.Array:
    chosen = options[0]
    for i, option in enumerate(options[1:], start=1):
        chosen = jnp.where(index == i, option, chosen)
    return chosen


def _along(start: Vector, edge: Vector) -> jax.Array:
    """How far along an edge from its start it is nearest to the origin, in 0 to 1."""
    length = dot(edge, edge)
    return jnp.clip(-dot(start, edge) / jnp.where(length > 0.0, length, 1.0), 0.0, 1.0)


def _nearest_feature(new: Vector, old: list[Vector]) -> jax.Array:
    """0 to 2: the edge to that old point; 3 to 5: the face with 01, 12, 20; or `_INSIDE`."""
    edges = [subtract(p, new) for p in old]
    spokes = [_cross(new, p) for p in old]
    squared = []
    for e in edges:
        t = _along(new, e)
        point = [x + t * y for x, y in zip(new, e, strict=True)]
        squared.append(dot(point, point))
    lengths = [dot(e, e) for e in edges]
    volume = dot(_cross(edges[0], edges[1]), edges[2])
    side = jnp.sign(volume)
    inside, total = volume != 0.0, 0.0
    for i, j in ((0, 1), (1, 2), (2, 0)):
        normal = _cross(edges[i], edges[j])
        area, height = dot(normal, normal), dot(normal, new)
        # Thinner triangles have no normal to speak of; their edges are as near.
        flat = area <= _FLAT * lengths[i] * lengths[j]
        over = (dot(normal, spokes[i]) >= 0.0) & (dot(normal, spokes[j]) <= 0.0)
        over &= dot(normal, _cross(old[i], old[j])) >= 0.0
        distance = height * height / jnp.where(flat, 1.0, area)
        squared.append(jnp.where(over & ~flat, distance, jnp.inf))
        inside &= ~flat & (side * height < 0.0) & (height * height > _DEEP * area)
        total -= side * height
    inside &= total <= jnp.abs(volume)
    best, chosen = squared[0], jnp.zeros(squared[0].shape, jnp.int32)
    for i, distance in enumerate(squared[1:], start=1):
        nearer = distance < best
        best, chosen = jnp.where(nearer, distance, best), jnp.where(nearer, i, chosen)
    return jnp.where(inside, _INSIDE, chosen)


def _once(function: Callable[..., jax.Array], turns: jax.Array, *args: Any) -> jax.Array:
    """Integers `[N]`, computed once for all that need them.

    The compiler computes again, for each result, whatever the result depends on, unless it comes
    out of a loop; and of this loop it cannot know that it has one turn.
    """

    def turn(_, index: jax.Array) -> jax.Array:
        return function(*jax.lax.optimization_barrier((args, index))[0])

    return jax.lax.fori_loop(0, turns, turn, jnp.zeros(args[0][0].shape, jnp.int32))
