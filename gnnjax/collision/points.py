"""The arm's parts as they are before the points of clouds, for what look-ups in grids leave open.

A direction that separates a part from one point (`convex.py`) separates it from most points nearby.
So of the points that may touch a part, the one that seems nearest is asked about, and all that lie
beyond the same plane are struck out, until one is in contact or none is left. Points are in leaves
and these in groups, which are struck out as a whole where the box around them is beyond the plane.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.kinematics import dot, transform_point
from gnnjax.arm.robot import Robot
from gnnjax.collision import convex
from gnnjax.collision.exact import hulls_of, part_frames, test_pairs
from gnnjax.scene.cloud import Cloud

_IN_LEAF, _IN_GROUP = 32, 64  # points, leaves
_TAKEN_LEAVES, _TAKEN_GROUPS = 8, 2  # whose points and whose leaves are looked at together
_PLANES = 4  # that are remembered for the points of leaves to come
_MOST_ROUNDS = 64  # planes for one part; what is open by then counts as touching
# What single precision rounds off: of positions, m, and of distances along a plane, as a share.
_ROUNDING, _SHARE = 1e-5, 1e-6
_FAR = 1e6  # m; where leaves without points are
_NOTHING = -1e3  # m; radius of a ball that is apart from everything

_Vector: TypeAlias = list[Any]  # of arrays, its components


class Boxes(NamedTuple):
    """Around points, by their middles and halves; far away where there are none."""

    middles: Float[Array, "*batch 3 K"]  # m
    halves: Float[Array, "*batch 3 K"]  # m


class Leaves(NamedTuple):
    """Points of P clouds, in G groups of E leaves of B that are near each other."""

    points: Float[Array, "P L 3 B"]  # m, L = G E; where there are fewer, one comes again
    boxes: Boxes  # [P G 3 E], around those of leaves
    groups: Boxes  # [P 3 G]


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


class _Taken(NamedTuple):
    """What was taken last, K each: leaves of groups, or points of leaves."""

    number: Int[Array, "N K"]  # of a leaf in its cloud; of points, of no use
    middles: _Vector  # [N K] m
    halves: _Vector | None  # [N K] m; of points, None
    gaps: Float[Array, "N K"]  # m, at least; infinite for those whose points were taken

    def left(self) -> Bool[Array, " N"]:
        return ~(self.gaps.min(axis=1) > 0)

    def beyond(self, plane: _Planes) -> "_Taken":
        return self._replace(gaps=jnp.maximum(self.gaps, plane.gaps(self.middles, self.halves)))


class _State(NamedTuple):
    rounds: Int[Array, ""]
    groups: _Taken  # all
    leaves: _Taken
    points: _Taken
    planes: list[_Planes]  # the last ones
    touching: Bool[Array, " N"]


def leaves_of(clouds: Cloud) -> Leaves | None:
    """The points of clouds `[P]`; None where these come without (`without_points`)."""
    num, room, _ = clouds.points.shape
    if not room:
        return None
    each = min(_IN_GROUP, -(-room // _IN_LEAF))
    points = jnp.pad(clouds.points, ((0, 0), (0, -room % (each * _IN_LEAF)), (0, 0)))
    exists = jnp.arange(points.shape[1]) < clouds.num[:, None]
    shape = num, -1, each, _IN_LEAF
    points, exists = points.reshape(*shape, 3), exists.reshape(*shape, 1)
    points = jnp.where(exists, points, points[:, :, :, :1])
    filled = exists[:, :, :, 0]
    low, high = points.min(axis=3), points.max(axis=3)  # [P G E 3]
    outer = (
        jnp.min(low, axis=2, where=filled, initial=jnp.inf),
        jnp.max(high, axis=2, where=filled, initial=-jnp.inf),
    )
    points = jnp.where(exists[:, :, :, :1], points, _FAR)
    points = jnp.swapaxes(points.reshape(num, -1, _IN_LEAF, 3), 2, 3)
    return Leaves(points, _boxes(low, high, filled), _boxes(*outer, filled.any(axis=2)))


def _boxes(low: jax.Array, high: jax.Array, filled: jax.Array) -> Boxes:
    """Corners `[..., K, 3]` as boxes."""
    middles = jnp.where(filled, (low + high) / 2, _FAR)
    # The box is to hold its points whatever is rounded off in its middle.
    halves = jnp.where(filled, (high - low) / 2 + _SHARE * (jnp.abs(low) + jnp.abs(high)), 0.0)
    return Boxes(jnp.swapaxes(middles, -1, -2), jnp.swapaxes(halves, -1, -2))


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
            middle = transform_point(list(position), axes, list(part_middles[part].T))
            more = ball + _ROUNDING
            box = _Box(middle, axes, [x + more for x in half], [x + more for x in around])
            lanes = jnp.arange(len(lane))[:, None]

            def side_by_side(array: jax.Array) -> _Vector:
                """`[N K 3 E]` as three `[N K*E]`."""
                return [array[:, :, a].reshape(len(lane), -1) for a in range(3)]

            def taken(
                state: _State,
                outer: _Taken,
                inner: _Taken,
                takes: jax.Array,
                most: int,
                look: Callable[[jax.Array], tuple[jax.Array, _Vector, _Vector | None]],
            ) -> tuple[_Taken, _Taken]:
                """Where it `takes`, what is in the nearest of `outer` in place of `inner`."""
                near, chosen = jax.lax.top_k(-outer.gaps, min(most, outer.gaps.shape[1]))
                number, middles, halves = look(outer.number[lanes, chosen])
                found = [shape.gaps(middles, halves) for shape in (box, *state.planes)]
                fresh = _Taken(number, middles, halves, functools.reduce(jnp.maximum, found))
                rest = outer.gaps.at[lanes, chosen].set(jnp.where(takes, jnp.inf, -near))
                return outer._replace(gaps=rest), jax.tree.map(
                    lambda new, old: jnp.where(takes, new, old), fresh, inner
                )

            def in_groups(number: jax.Array) -> tuple[jax.Array, _Vector, _Vector]:
                each = leaves.boxes.middles.shape[-1]
                inside = (number[:, :, None] * each + jnp.arange(each)).reshape(len(lane), -1)
                middles, halves = (side_by_side(x[of[:, None], number]) for x in leaves.boxes)
                return inside, middles, halves

            def in_leaves(number: jax.Array) -> tuple[jax.Array, _Vector, None]:
                points = side_by_side(leaves.points[of[:, None], number])
                return jnp.zeros(points[0].shape, jnp.int32), points, None

            def lacks_leaves(state: _State) -> jax.Array:
                left = state.points.left() | state.leaves.left()
                return ~state.touching & ~left & state.groups.left()

            def lacks_points(state: _State) -> jax.Array:
                left = state.leaves.left() | state.groups.left()
                return ~state.touching & ~state.points.left() & left

            def take_groups(state: _State) -> _State:
                takes = lacks_leaves(state)[:, None]
                groups, inside = taken(
                    state, state.groups, state.leaves, takes, _TAKEN_GROUPS, in_groups
                )
                return state._replace(groups=groups, leaves=inside)

            def take_leaves(state: _State) -> _State:
                state = jax.lax.while_loop(lambda x: jnp.any(lacks_leaves(x)), take_groups, state)
                takes = lacks_points(state)[:, None]
                rest, points = taken(
                    state, state.leaves, state.points, takes, _TAKEN_LEAVES, in_leaves
                )
                return state._replace(leaves=rest, points=points)

            def one_round(state: _State) -> _State:
                state = jax.lax.while_loop(lambda x: jnp.any(lacks_points(x)), take_leaves, state)
                chosen = jnp.argmin(state.points.gaps, axis=1)[:, None]
                point = [x[lanes, chosen][:, 0] for x in state.points.middles]
                asked = ~state.touching & state.points.left()
                nothing = jnp.zeros_like(ball)
                shapes = convex.Sums(
                    jnp.stack([nothing] * 3), nothing, jnp.where(asked, ball, _NOTHING)
                )
                found = convex.separate_obstacles(
                    hulls, part, position - jnp.stack(point), rotation, shapes
                )
                gap = jnp.where(asked, found.gaps - _ROUNDING, -jnp.inf)
                plane = _Planes(list(found.directions), point, gap)
                return _State(
                    state.rounds + 1,
                    state.groups.beyond(plane),
                    state.leaves.beyond(plane),
                    state.points.beyond(plane),
                    [plane, *state.planes[:-1]],
                    state.touching | (asked & ~(gap > 0)),
                )

            def is_open(state: _State) -> jax.Array:
                left = state.points.left() | state.leaves.left() | state.groups.left()
                return ~state.touching & left

            def unfinished(state: _State) -> jax.Array:
                return jnp.any(is_open(state)) & (state.rounds < _MOST_ROUNDS)

            def nothing_taken(num: int, *, boxes: bool) -> _Taken:
                zeros = jnp.zeros((len(lane), num))
                halves = [zeros] * 3 if boxes else None
                return _Taken(zeros.astype(jnp.int32), [zeros] * 3, halves, zeros + jnp.inf)

            _, num_groups, _, each = leaves.boxes.middles.shape
            num_leaves = min(_TAKEN_GROUPS, num_groups) * each
            num_points = min(_TAKEN_LEAVES, num_leaves) * leaves.points.shape[-1]
            middles, halves = ([x[of, a] for a in range(3)] for x in leaves.groups)
            numbers = jnp.broadcast_to(jnp.arange(num_groups), middles[0].shape)
            zeros = jnp.zeros(len(lane))
            start = _State(
                jnp.int32(0),
                _Taken(numbers, middles, halves, box.gaps(middles, halves)),
                nothing_taken(num_leaves, boxes=True),
                nothing_taken(num_points, boxes=False),
                [_Planes([zeros] * 3, [zeros] * 3, zeros - jnp.inf)] * _PLANES,
                jnp.zeros(len(lane), bool),
            )
            end = jax.lax.while_loop(unfinished, one_round, start)
            return jnp.where(end.touching | is_open(end), -1.0, 1.0)

        return test_pairs(wanted, gaps)

    return clear
