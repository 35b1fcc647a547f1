"""The arm's parts as they are before the points of clouds, for what look-ups in grids leave open.

A direction that separates a part from one point (`convex.py`) separates it from most points nearby.
So of the points that may touch a part, the one that seems nearest is asked about, and all that lie
beyond the same plane are struck out, until one is in contact or none is left. Points are in leaves,
which are struck out as a whole where the box around them is beyond the plane.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.kinematics import dot, transform
from gnnjax.arm.robot import Robot
from gnnjax.collision import convex
from gnnjax.collision.exact import hulls_of, part_frames, test_pairs
from gnnjax.scene.cloud import Cloud

_IN_LEAF, _MOST_LEAVES = 32, 2048  # points, unless there are more leaves than that
_TAKEN = 8  # leaves, whose points are looked at together
_PLANES = 4  # that are remembered for the points of leaves to come
_MOST_ROUNDS = 64  # planes for one part; what is open by then counts as touching
# What single precision rounds off: of positions, m, and of distances along a plane, as a share.
_ROUNDING, _SHARE = 1e-5, 1e-6
_FAR = 1e6  # m; where leaves without points are
_NOTHING = -1e3  # m; radius of a ball that is apart from everything

_Vector: TypeAlias = list[Any]  # of arrays, its components


class Leaves(NamedTuple):
    """Points of P clouds, B each that are near each other, and the boxes around these."""

    points: Float[Array, "P L 3 B"]  # m; where there are fewer, one comes again
    middles: Float[Array, "P 3 L"]  # m
    halves: Float[Array, "P 3 L"]  # m


class _Planes(NamedTuple):
    """Planes of N parts, which separate them from points; components by themselves."""

    normal: _Vector  # [N], of unit length, towards the part
    point: _Vector  # [N] m
    gap: Float[Array, "..."]  # [N] m, between the part and the ball about that point

    def gaps(self, places: _Vector, halves: _Vector | None = None) -> jax.Array:
        """Of the balls about places `[N K]`, or about all of the boxes around these: m."""
        found = self.gap[:, None]
        for a, (n, point, place) in enumerate(zip(self.normal, self.point, places, strict=True)):
            away = point[:, None] - place
            found = found + n[:, None] * away - _SHARE * jnp.abs(away)
            if halves is not None:
                found = found - (jnp.abs(n)[:, None] + _SHARE) * halves[a]
        return found


class _Box(NamedTuple):
    """Boxes around N parts and the balls of points; components by themselves."""

    middle: _Vector  # [N] m
    axes: list[_Vector]  # [N]; a column is an axis of the box
    halves: _Vector  # [N] m, along its own axes
    around: _Vector  # [N] m, along those of the base

    def gaps(self, places: _Vector, halves: _Vector | None = None) -> jax.Array:
        """As `_Planes.gaps`, for planes along the axes of base and box."""
        away = [x - m[:, None] for x, m in zip(places, self.middle, strict=True)]
        lost, beyond = 0.0, []
        for a, x in enumerate(away):
            size = jnp.abs(x)
            beyond.append(size - self.around[a][:, None])
            if halves is not None:
                beyond[a] = beyond[a] - halves[a]
                size = size + halves[a]
            lost = lost + _SHARE * size
        for column, half in zip(zip(*self.axes, strict=True), self.halves, strict=True):
            column = [x[:, None] for x in column]
            along = jnp.abs(dot(column, away)) - half[:, None]
            if halves is not None:
                along = along - dot([jnp.abs(x) for x in column], halves)
            beyond.append(along)
        return functools.reduce(jnp.maximum, beyond) - lost


class _State(NamedTuple):
    rounds: Int[Array, ""]
    leaves: Float[Array, "N L"]  # gaps at least, m; infinite for those whose points were taken
    points: _Vector  # [N H] m, of the leaves that were taken last
    gaps: Float[Array, "N H"]  # of these, at least, m
    planes: list[_Planes]  # the last ones
    touching: Bool[Array, " N"]


def leaves_of(clouds: Cloud) -> Leaves | None:
    """The points of clouds `[P]`; None where these come without (`without_points`)."""
    num, room, _ = clouds.points.shape
    if not room:
        return None
    each = max(_IN_LEAF, -(-room // _MOST_LEAVES))
    points = jnp.pad(clouds.points, ((0, 0), (0, -room % each), (0, 0)))
    exists = jnp.arange(points.shape[1]) < clouds.num[:, None]
    points, exists = points.reshape(num, -1, each, 3), exists.reshape(num, -1, each, 1)
    points = jnp.where(exists, points, points[:, :, :1])
    points = jnp.where(exists[:, :, :1], points, _FAR)
    low, high = (jnp.moveaxis(f(points, axis=2), 1, 2) for f in (jnp.min, jnp.max))
    # The box is to hold its points whatever is rounded off in its middle.
    halves = (high - low) / 2 + _SHARE * (jnp.abs(low) + jnp.abs(high))
    return Leaves(jnp.swapaxes(points, 2, 3), (low + high) / 2, halves)


def clear_of_points(
    robot: Robot,
) -> Callable[[Leaves, jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]:
    """Makes the function `(leaves, radius [P], owner [N], q [N D], wanted [T N]) -> [N]`, of an arm
    of T parts: whether none that is wanted touches a ball of the owner's cloud."""
    hulls = hulls_of(robot)
    bodies = jnp.array([part.body for part in robot.parts])  # the world's frame comes last
    low, high = hulls.vertices.min(axis=1), hulls.vertices.max(axis=1)
    part_middles, part_halves = (low + high) / 2, (high - low) / 2 + hulls.radii[:, None]

    def clear(
        leaves: Leaves,
        radius: Float[Array, " P"],
        owner: Int[Array, " N"],
        q: Float[Array, "N D"],
        wanted: Bool[Array, "T N"],
    ) -> Bool[Array, " N"]:
        frames = part_frames(robot, q)

        def gaps(part: jax.Array, lane: jax.Array) -> jax.Array:
            of, (position, rotation) = owner[lane], frames[bodies[part], lane]
            ball, axes = radius[of], [list(row) for row in rotation]
            half = list(part_halves[part].T)
            around = [dot([jnp.abs(x) for x in row], half) for row in axes]
            middle = transform(list(position), axes, list(part_middles[part].T))
            more = ball + _ROUNDING
            box = _Box(middle, axes, [x + more for x in half], [x + more for x in around])
            boxes, extents = ([x[of, a] for a in range(3)] for x in (leaves.middles, leaves.halves))
            lanes, taken = jnp.arange(len(lane))[:, None], min(_TAKEN, leaves.points.shape[1])

            def points_left(state: _State) -> jax.Array:
                return ~(state.gaps.min(axis=1) > 0)

            def leaves_left(state: _State) -> jax.Array:
                return ~(state.leaves.min(axis=1) > 0)

            def to_take(state: _State) -> jax.Array:
                return ~state.touching & ~points_left(state) & leaves_left(state)

            def take_leaves(state: _State) -> _State:
                takes = to_take(state)[:, None]
                near, chosen = jax.lax.top_k(-state.leaves, taken)
                points = leaves.points[of[:, None], chosen]  # [N K 3 B]
                points = [points[:, :, a].reshape(len(lane), -1) for a in range(3)]
                found = [shape.gaps(points) for shape in (box, *state.planes)]
                left = state.leaves.at[lanes, chosen].set(jnp.where(takes, jnp.inf, -near))
                return state._replace(
                    leaves=left,
                    points=[jnp.where(takes, *x) for x in zip(points, state.points, strict=True)],
                    gaps=jnp.where(takes, functools.reduce(jnp.maximum, found), state.gaps),
                )

            def one_round(state: _State) -> _State:
                state = jax.lax.while_loop(lambda x: jnp.any(to_take(x)), take_leaves, state)
                chosen = jnp.argmin(state.gaps, axis=1)[:, None]
                point = [x[lanes, chosen][:, 0] for x in state.points]
                asked = ~state.touching & points_left(state)
                nothing = jnp.zeros_like(ball)
                shapes = convex.Obstacles(
                    jnp.stack([nothing] * 3), nothing, jnp.where(asked, ball, _NOTHING)
                )
                found = convex.separate_obstacles(
                    hulls, part, position - jnp.stack(point), rotation, shapes
                )
                gap = jnp.where(asked, found.gaps - _ROUNDING, -jnp.inf)
                plane = _Planes(list(found.directions), point, gap)
                return _State(
                    state.rounds + 1,
                    jnp.maximum(state.leaves, plane.gaps(boxes, extents)),
                    state.points,
                    jnp.maximum(state.gaps, plane.gaps(state.points)),
                    [plane, *state.planes[:-1]],
                    state.touching | (asked & ~(gap > 0)),
                )

            def is_open(state: _State) -> jax.Array:
                return ~state.touching & (points_left(state) | leaves_left(state))

            def unfinished(state: _State) -> jax.Array:
                return jnp.any(is_open(state)) & (state.rounds < _MOST_ROUNDS)

            zeros = jnp.zeros(len(lane))
            none = jnp.zeros((len(lane), taken * leaves.points.shape[-1]))
            start = _State(
                jnp.int32(0),
                box.gaps(boxes, extents),
                [none] * 3,
                none + jnp.inf,
                [_Planes([zeros] * 3, [zeros] * 3, zeros - jnp.inf)] * _PLANES,
                jnp.zeros(len(lane), bool),
            )
            end = jax.lax.while_loop(unfinished, one_round, start)
            return jnp.where(end.touching | is_open(end), -1.0, 1.0)

        return test_pairs(wanted, gaps)

    return clear
