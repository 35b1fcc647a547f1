"""Many edges at once: what one configuration proves of those before and after it.

How far any sphere around the arm moves along an edge is bounded (`bounds.py`). Where all of them
are farther from an obstacle than they move in k steps, the first level of the test (`fused.py`)
would find the k configurations before and after this one free of that obstacle, too, and they need
not be looked at. What is found of an edge is what testing all of its configurations finds: those
whose spheres leave something open are decided one by one by the parts themselves, and prove
nothing of others.

A row is a stretch of an edge, and an obstacle of which it is not known to be free. The middle is
looked at, and what it leaves of the stretch makes up to two rows of at most half the length. Rows
of all edges wait on one stack, from which as many are taken at once as the machine likes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.kinematics import joint_terms
from gnnjax.arm.robot import Robot
from gnnjax.collision.bounds import spheres_of
from gnnjax.collision.edges import configurations_at
from gnnjax.collision.exact import PartTests
from gnnjax.collision.placed import Obstacle, Placed
from gnnjax.collision.spheres import Passes, in_passes

_ROWS = 512  # looked at together
# As `_SELF_PAIRS_A_PASS` in `spheres.py`.
_SPHERES_A_PASS = 32
_OPEN = 128  # configurations that spheres leave open, decided together
_ROUNDING = 1e-4  # m; far more than float32 loses of what is compared
# What the spheres at a configuration say: this, or how many steps before and after it are free.
_BLOCKED, _IS_OPEN = -2.0, -1.0
_FAR = 30_000.0  # steps, more than edges have


class Edges(NamedTuple):
    """Edges, cut into intervals; see `cut_edges`."""

    low: Float[Array, "E D"]
    high: Float[Array, "E D"]
    intervals: Int[Array, " E"]

    def at(self, edge: jax.Array, point: jax.Array) -> jax.Array:
        """Configurations `[B D]`, the very ones that testing edges one by one tests."""
        low, high = self.low[edge], self.high[edge]
        return configurations_at(low, high - low, self.intervals[edge], point)

    def within(self, inside: Callable[[jax.Array], jax.Array]) -> Bool[Array, " E"]:
        """Which have all configurations between their ends in a box: the outermost are."""
        every = jnp.arange(len(self.low))
        both = inside(self.at(every, every * 0 + 1)) & inside(self.at(every, self.intervals - 1))
        return both | (self.intervals < 2)

    def steps(self, edge: jax.Array) -> jax.Array:
        """`[B D]` how far joints move from one configuration to the next."""
        return jnp.abs(self.high[edge] - self.low[edge]) / self.intervals[edge][:, None]


class Stretches:
    """The test of an arm."""

    def __init__(self, robot: Robot, second: PartTests | None, most_intervals: int):
        """Args:
        robot: the arm.
        second: its parts' tests; None for an arm whose spheres leave nothing open.
        """
        self._robot, self._second, self._passes = robot, second, Passes(robot)
        self._most_intervals = most_intervals
        self._bodies = robot.sphere_bodies.tolist()
        self._radii = robot.sphere_radii.tolist()
        inner = robot.sphere_inner_radii if second is not None else robot.sphere_radii
        self._inner = [x if x > 0 else None for x in inner.tolist()]
        moving = self._passes.moving
        self._groups = [x.tolist() for x in in_passes(np.array(moving), _SPHERES_A_PASS)]
        body = spheres_of(robot)
        reach = np.maximum.reduceat(body.reach, body.first, axis=0)
        links = body.links.tolist()
        self._reach = dict(zip(links, reach, strict=True))
        self._moving = {key: self._reach[key] for key in robot.sphere_bodies[moving].tolist()}
        upstream = dict(zip(links, body.upstream, strict=True))
        # A joint that carries both links leaves their distance alone.
        self._pair_reach = {
            (i, j): np.where(upstream[i] & upstream[j], 0.0, self._reach[i] + self._reach[j])
            for i, j in robot.sphere_bodies[robot.sphere_pairs].tolist()
        }

    def free(self, placed: Placed, edges: Edges, valid: Bool[Array, " E"]) -> Bool[Array, " E"]:
        """Which of the edges that are `valid` have no configuration with a contact between their
        ends.

        Args:
            placed: of one scene.
            edges: E.
            valid: others are not looked at.
        """
        valid = self._clear_of_obstacles(placed, edges, valid)
        return self._clear_of_itself(edges, valid) if self._pair_reach else valid

    def _clear_of_obstacles(
        self, placed: Placed, edges: Edges, valid: Bool[Array, " E"]
    ) -> Bool[Array, " E"]:
        table = jax.tree.map(lambda x: x[..., 0], tuple(placed)[:-1])

        def look(edge: jax.Array, thing: jax.Array, point: jax.Array) -> jax.Array:
            parts = jax.tree.map(lambda x: jnp.moveaxis(x[thing], 0, -1), table)
            steps = _steps_a_meter(edges.steps(edge), self._moving)
            terms = parts, joint_terms(self._robot, edges.at(edge, point)), steps
            found = jnp.full(len(edge), _FAR)
            turns = jnp.any(valid).astype(jnp.int32)  # one, or nothing would be looked at
            for spheres in self._groups:

                def turn(_, found, spheres=spheres):
                    (parts, joints, steps), found = jax.lax.optimization_barrier((terms, found))
                    obstacle, nearest = Obstacle(*parts), {}
                    for g, squared, ball in self._passes.to_obstacle(joints, obstacle, spheres):
                        inner = _sum(self._inner[g], ball)
                        found = _said(found, squared, self._radii[g] + ball, inner)
                        _keep_nearest(nearest, self._bodies[g], jnp.sqrt(squared) - self._radii[g])
                    for link, gap in nearest.items():
                        found = _within(found, gap - obstacle.radii[1], steps[link])
                    return found

                found = jax.lax.fori_loop(0, turns, turn, found)
            return found

        def decide(edge, thing, point, wanted) -> jax.Array:
            assert self._second is not None
            q, owner = edges.at(edge, point), jnp.zeros_like(edge)
            return self._second.clear_of_obstacles(placed, owner, thing, q, wanted)

        return self._prove(edges, placed.num[0], valid, look, decide)

    def _clear_of_itself(self, edges: Edges, valid: Bool[Array, " E"]) -> Bool[Array, " E"]:
        def look(edge: jax.Array, thing: jax.Array, point: jax.Array) -> jax.Array:
            steps = _steps_a_meter(edges.steps(edge), self._pair_reach)
            terms = joint_terms(self._robot, edges.at(edge, point)), steps
            found = jnp.full(len(edge), _FAR)
            turns = jnp.any(valid).astype(jnp.int32)  # one, or nothing would be looked at
            for pairs in self._passes.self_pairs:

                def turn(_, found, pairs=pairs):
                    (joints, steps), found = jax.lax.optimization_barrier((terms, found))
                    nearest = {}
                    for i, j, squared in self._passes.to_itself(joints, pairs):
                        reach = self._radii[i] + self._radii[j]
                        found = _said(found, squared, reach, _sum(self._inner[i], self._inner[j]))
                        links = self._bodies[i], self._bodies[j]
                        _keep_nearest(nearest, links, jnp.sqrt(squared) - reach)
                    for links, gap in nearest.items():
                        found = _within(found, gap, steps[links])
                    return found

                found = jax.lax.fori_loop(0, turns, turn, found)
            return found

        def decide(edge, thing, point, wanted) -> jax.Array:
            assert self._second is not None
            return self._second.clear_of_itself(edges.at(edge, point), wanted)

        return self._prove(edges, jnp.int32(1), valid, look, decide)

    def _prove(
        self,
        edges: Edges,
        num_things: jax.Array,
        valid: jax.Array,
        look: Callable[..., jax.Array],
        decide: Callable[..., jax.Array],
    ) -> jax.Array:
        """Which of the `valid` edges are free of some things.

        Args:
            edges: E.
            num_things: that count, the first ones.
            valid: `[E]`.
            look: what spheres say, `(edge [B], thing [B], point [B]) -> [B]`.
            decide: what parts say, of all that is wanted, `(edge, thing, point, wanted) -> [N]`.
        """
        nobody = len(valid)
        room = 2 * _ROWS * (self._most_intervals.bit_length() + 2)
        (queue,) = jnp.nonzero(valid & (edges.intervals > 1), size=nobody, fill_value=nobody)
        num_roots = (valid & (edges.intervals > 1)).sum() * num_things
        lane = jnp.arange(_ROWS)

        def left_to_look(state):
            entered, height, *_ = state
            return (height > 0) | (entered < num_roots)

        def look_at_some(state):
            entered, height, rows, num_open, opened, valid = state
            begin = jnp.maximum(height - _ROWS, 0)
            held = height - begin
            number = entered + lane - held
            of, thing = jnp.divmod(number, jnp.maximum(num_things, 1))
            root_edge = queue[jnp.clip(of, 0, nobody - 1)]
            is_held = lane < held
            row = jax.lax.dynamic_slice(rows, (begin, 0), (_ROWS, 4))
            exists = is_held | (number < num_roots)
            edge = jnp.minimum(jnp.where(is_held, row[:, 0], root_edge), nobody - 1)
            thing = jnp.where(is_held, row[:, 1], thing)
            first = jnp.where(is_held, row[:, 2], 1)
            last = jnp.where(is_held, row[:, 3], edges.intervals[edge] - 1)
            entered = jnp.minimum(entered + _ROWS - held, num_roots)
            wanted = exists & valid[edge]
            middle = (first + last) // 2
            found = jax.lax.optimization_barrier(look(edge, thing, middle))
            blocked = wanted & (found == _BLOCKED)
            valid = valid.at[jnp.where(blocked, edge, nobody)].set(False, mode="drop")
            wanted &= valid[edge]
            reach = jnp.maximum(found * (1.0 - 1e-5), 0.0).astype(jnp.int32)  # rounded down
            new = jnp.stack(
                [
                    jnp.tile(edge, 2),
                    jnp.tile(thing, 2),
                    jnp.concatenate([first, middle + 1 + reach]),
                    jnp.concatenate([middle - 1 - reach, last]),
                ],
                axis=1,
            )
            rows, height = _push(rows, begin, new, jnp.tile(wanted, 2) & (new[:, 2] <= new[:, 3]))
            is_open = wanted & (found == _IS_OPEN)
            new = jnp.stack([edge, thing, middle], axis=1)
            opened, num_open = _push(opened, num_open, new, is_open)
            return entered, height, rows, num_open, opened, valid

        def decide_some(state):
            entered, height, rows, num_open, opened, valid = state
            wanted = (jnp.arange(len(opened)) < num_open) & valid[opened[:, 0]]
            opened, num_open = _push(opened, jnp.int32(0), opened, wanted)
            begin = jnp.maximum(num_open - _OPEN, 0)
            edge, thing, point = jax.lax.dynamic_slice(opened, (begin, 0), (_OPEN, 3)).T
            wanted = jnp.arange(_OPEN) < num_open - begin
            clear = decide(edge, thing, point, wanted)
            valid = valid.at[jnp.where(clear, nobody, edge)].set(False, mode="drop")
            return entered, height, rows, begin, opened, valid

        def some_turns(state):
            state = jax.lax.while_loop(
                lambda s: left_to_look(s) & (s[3] < _OPEN), look_at_some, state
            )
            if self._second is None:
                return state
            return jax.lax.while_loop(
                lambda s: (s[3] >= _OPEN) | ((s[3] > 0) & ~left_to_look(s)), decide_some, state
            )

        none = jnp.int32(0)
        rows, opened = jnp.zeros((room, 4), jnp.int32), jnp.zeros((_OPEN + _ROWS, 3), jnp.int32)
        state = none, none, rows, none, opened, valid
        state = jax.lax.while_loop(lambda s: left_to_look(s) | (s[3] > 0), some_turns, state)
        return state[-1]


def _push(stack: jax.Array, height: jax.Array, rows: jax.Array, wanted: jax.Array):
    """A stack `[S C]` with the wanted of some rows `[R C]` on it, and how high it is then."""
    count = jnp.cumsum(wanted.astype(jnp.int32))
    at = jnp.where(wanted, height + count - 1, len(stack))
    return stack.at[at].set(rows, mode="drop"), height + count[-1]


def _steps_a_meter(steps: jax.Array, reach: dict) -> dict:
    """How many steps it takes what has a reach `[D]` to move by a metre, at least, `[B]`."""
    rates = {
        key: sum(float(by) * step for by, step in zip(of, steps.T, strict=True) if by > 0.0)
        for key, of in reach.items()
    }
    # What does not move takes more than any edge has.
    return {key: 1.0 / (rate + jnp.full(len(steps), 1e-9)) for key, rate in rates.items()}


def _said(found: jax.Array, squared: jax.Array, reach: Any, inner: Any) -> jax.Array:
    """What a squared distance says of a configuration, by the very comparisons of the first level
    of the test."""
    found = jnp.where(~(squared > reach**2), jnp.minimum(found, _IS_OPEN), found)
    return found if inner is None else jnp.where(~(squared > inner**2), _BLOCKED, found)


def _sum(a: Any, b: Any) -> Any:
    return None if a is None or b is None else a + b


def _keep_nearest(nearest: dict, key, gap: jax.Array) -> None:
    nearest[key] = jnp.where(gap < nearest[key], gap, nearest[key]) if key in nearest else gap


def _within(found: jax.Array, gap: jax.Array, per_meter: jax.Array) -> jax.Array:
    """The number of steps within which a gap cannot be used up, where that is less than what was
    found."""
    enough = (gap - _ROUNDING) * per_meter
    enough = jnp.where(enough > 0.0, enough, 0.0)
    return jnp.where(enough < found, enough, found)
