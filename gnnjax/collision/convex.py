"""Whether convex bodies are apart, proven by a direction; on lists of components.

A part of the robot is the convex hull of vertices and a ball around each of its points (Minkowski
sum): a mesh's hull, a capsule (two vertices), a sphere (one). An obstacle is, in its own frame, the
sum of an axis-aligned box, a disc in the xy plane and a ball, each of which may be a point: box,
cylinder, capsule, sphere.

The test is that of Gilbert, Johnson and Keerthi (1988): of the difference of two bodies, which
holds the origin just when they meet, it keeps up to three points, and asks for the farthest one in
the direction from their hull to the origin. It ends, for a pair, as soon as a direction separates.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.kinematics import Matrix, Vector, dot, subtract, transform_point
from gnnjax.collision.simplex import nearest_point

MAX_ROUNDS = 32
# Of the sizes and distances in metres that go into a gap, as a bound on what float32 loses of them.
_ROUNDING = 1.5e-6
_TOUCHING = 2e-5  # m; bodies nearer than this are not pulled apart any further
# As `_SELF_PAIRS_A_PASS` in `fused.py`.
_VERTICES_A_PASS = 64


class Parts(NamedTuple):
    """T parts of robots; those with fewer vertices repeat one."""

    vertices: Float[Array, "T V 3"]  # m, in the frame of the part's body
    radii: Float[Array, " T"]  # of the ball, m


class Sums(NamedTuple):
    """N obstacles, each in its own frame."""

    half_extents: Float[Array, "3 N"]  # of the box, m
    discs: Float[Array, " N"]  # radius, m
    balls: Float[Array, " N"]  # radius, m


class Separation(NamedTuple):
    """What is proven about N pairs."""

    gaps: Float[Array, " N"]  # m; the bodies are at least so far apart, where that is above 0
    directions: Float[Array, "3 N"]  # of unit length, in the other's frame, in which they are so


class _State(NamedTuple):
    rounds: Int[Array, ""]
    undecided: Bool[Array, " N"]
    nearest: Vector  # to the origin in the hull of `points`
    points: list[Vector]  # three of the difference
    gaps: Float[Array, " N"]
    directions: Vector


def separate_obstacles(
    parts: Parts,
    part: Int[Array, " N"],
    position: Float[Array, "3 N"],
    rotation: Float[Array, "3 3 N"],
    obstacles: Sums,
    direction: Float[Array, "3 N"] | None = None,
) -> Separation:
    """Bounds how far parts are from obstacles.

    Pairs that are 0.05 mm apart are separated; where no ball rounds either body, float32 may leave
    the direction too coarse for that, and it may take 0.1 mm.

    Args:
        parts: of the robot.
        part: of each pair.
        position: of the part's body, seen from the obstacle, m.
        rotation: of the part's body, seen from the obstacle.
        obstacles: of each pair.
        direction: in which to look first, from the obstacle to the part, of any length; None is
            from where the obstacle is nearest to the part's middle, which alone separates most of
            those that are apart.
    """
    vertices, reach = _of_each(parts, part)
    extents, discs = list(obstacles.half_extents), obstacles.discs
    rows = [list(row) for row in rotation]

    def support(n: Vector, turns: jax.Array) -> Vector:
        lowest = _lowest(vertices, _turned_back(rows, n), turns)
        across = dot(n[:2], n[:2])
        stretch = discs * jax.lax.rsqrt(jnp.where(across > 0.0, across, 1.0))
        farthest = [jnp.where(x > 0.0, h, -h) for x, h in zip(n, extents, strict=True)]
        farthest = [farthest[0] + stretch * n[0], farthest[1] + stretch * n[1], farthest[2]]
        return subtract(transform_point(list(position), rows, lowest), farthest)

    size = reach + sum(extents) + discs + jnp.sum(jnp.abs(position), axis=0)
    radii = parts.radii[part] + obstacles.balls
    inner = transform_point(list(position), rows, list(_middles(parts)[part].T))
    first = _outwards(inner, obstacles) if direction is None else list(direction)
    return _separate(support, inner, radii, size, first)


def _outwards(point: Vector, obstacles: Sums) -> Vector:
    """From about the nearest point of obstacles to a point; from the middle where it is inside."""
    x, y, z = obstacles.half_extents
    sizes = x + obstacles.discs, y + obstacles.discs, z
    beyond = [p - jnp.clip(p, -h, h) for p, h in zip(point, sizes, strict=True)]
    outside = dot(beyond, beyond) > 0.0
    return [jnp.where(outside, b, p) for b, p in zip(beyond, point, strict=True)]


def separate_parts(
    parts: Parts,
    part: Int[Array, " N"],
    position: Float[Array, "3 N"],
    rotation: Float[Array, "3 3 N"],
    other: Int[Array, " N"],
    direction: Float[Array, "3 N"],
    margin: Float[Array, " N"],
) -> Separation:
    """Bounds how far parts are from other parts; see `separate_obstacles`.

    Args:
        other: the part from whose body the pair is seen.
        margin: what is not farther apart counts as touching, m.
    """
    # Both in one pass: half as much to compile.
    vertices, reach = _of_each(parts, jnp.concatenate([part, other]))
    rows = [list(row) for row in rotation]

    def support(n: Vector, turns: jax.Array) -> Vector:
        both = [jnp.concatenate([x, -y]) for x, y in zip(_turned_back(rows, n), n, strict=True)]
        lowest = [jnp.split(x, 2) for x in _lowest(vertices, both, turns)]
        seen = transform_point(list(position), rows, [x for x, _ in lowest])
        return subtract(seen, [y for _, y in lowest])

    size = jnp.sum(jnp.abs(position), axis=0) + sum(jnp.split(reach, 2))
    radii = parts.radii[part] + parts.radii[other] + margin
    middles = _middles(parts)
    inner = transform_point(list(position), rows, list(middles[part].T))
    return _separate(support, subtract(inner, list(middles[other].T)), radii, size, list(direction))


def _middles(parts: Parts) -> jax.Array:
    return jnp.mean(parts.vertices, axis=1)


def _turned_back(rows: Matrix, n: Vector) -> Vector:
    return [dot(column, n) for column in zip(*rows, strict=True)]


def _of_each(parts: Parts, part: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Vertices `[C, 3K, N]` of every pair's part, K a pass; how far they are from its origin, m."""
    reach = jnp.max(jnp.linalg.norm(parts.vertices, axis=-1), axis=-1)
    num_parts, num, _ = parts.vertices.shape
    passes = -(-num // _VERTICES_A_PASS)
    each = -(-num // passes)
    vertices = jnp.pad(parts.vertices, ((0, 0), (0, passes * each - num), (0, 0)), mode="edge")
    rows = vertices.reshape(num_parts, -1)[part]
    return rows.T.reshape(passes, 3 * each, len(part)), reach[part]


def _lowest(vertices: jax.Array, n: Vector, turns: jax.Array) -> Vector:
    """Of each pair's vertices the one that lies lowest in the direction n."""
    passes, rows, size = vertices.shape

    def one_pass(i: jax.Array, indices: jax.Array) -> jax.Array:
        # Taken out first: a loop that also looks for its pass is not turned into vector code.
        points = jax.lax.optimization_barrier(vertices[i])
        lowest, index = dot(n, list(points[:3])), jnp.zeros(size, jnp.int32)
        for v in range(1, rows // 3):
            height = dot(n, list(points[3 * v : 3 * v + 3]))
            lower = height < lowest
            lowest, index = jnp.where(lower, height, lowest), jnp.where(lower, v, index)
        return indices.at[i].set(index)

    # The indices alone, and out of a loop: see `simplex.py`.
    start = jnp.zeros((passes, size), jnp.int32)
    indices = jax.lax.fori_loop(0, passes * turns, one_pass, start)
    found: list[Vector] = [
        [vertices[i, 3 * indices[i] + a, jnp.arange(size)] for a in range(3)] for i in range(passes)
    ]
    best: Vector = found[0]
    for other in found[1:]:
        lower = dot(n, other) < dot(n, best)
        best = [jnp.where(lower, x, y) for x, y in zip(other, best, strict=True)]
    return best


def _separate(
    support: Callable[[Vector, jax.Array], Vector],
    inner: Vector,
    radii: jax.Array,
    size: jax.Array,
    direction: Vector,
) -> Separation:
    """Separates the origin from a difference of bodies by more than their balls' radii.

    Args:
        support: the point of the difference that lies lowest in a direction.
        inner: some point of the difference.
        radii: sum of both balls', m.
        size: bound on all coordinates, m.
        direction: in which to look first.
    """
    lost = _ROUNDING * (size + radii)

    def one_round(state: _State) -> _State:
        n = _unit(state.nearest)
        turns = jnp.any(state.undecided).astype(jnp.int32)  # one, or there would be no round
        point = support(n, turns)
        found = dot(n, point) - radii - lost
        # Whoever is done with stays as it is, whatever the others still need.
        better = state.undecided & (found > state.gaps)  # never so for NaN
        gaps = jnp.where(better, found, state.gaps)
        nearest, points, inside = nearest_point(point, state.points, turns)
        # No direction shows more than what is nearest leaves.
        improvable = jnp.sqrt(dot(nearest, nearest)) > gaps + radii + lost + _TOUCHING
        return _State(
            state.rounds + 1,
            state.undecided & ~(gaps > 0.0) & ~inside & improvable,
            nearest,
            points,
            gaps,
            [jnp.where(better, x, y) for x, y in zip(n, state.directions, strict=True)],
        )

    somewhere = dot(direction, direction) > 0.0  # not so for NaN
    start = _State(
        jnp.int32(0),
        jnp.ones(radii.shape, bool),
        [jnp.where(somewhere, x, y) for x, y in zip(direction, (1.0, 0.0, 0.0), strict=True)],
        [inner] * 3,
        jnp.full_like(radii, -jnp.inf),
        [jnp.zeros_like(radii)] * 3,
    )
    end = jax.lax.while_loop(
        lambda s: jnp.any(s.undecided) & (s.rounds < MAX_ROUNDS), one_round, start
    )
    return Separation(end.gaps, jnp.stack(end.directions))


def _unit(v: Vector) -> Vector:
    scale = jax.lax.rsqrt(dot(v, v))
    return [x * scale for x in v]
