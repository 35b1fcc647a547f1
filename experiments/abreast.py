"""A search for accelerators: straight lines, roadmaps and shortcuts of all problems abreast.

The engine decides on the host what is worth testing, in calls that suit the caches of a CPU. An
accelerator wants fewer and larger calls, and tests that may turn out needless rather than another
decision. Here all that is unknown of a path is tested at once, and shortcuts are those of
`gnnjax/planning/shorten_by_tests.py`, as functions of arrays. On a CPU it takes as much time as the
engine and three quarters more checks; `experiments.accelerator` times it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from experiments.path_points import FIRST, POINTS, SECOND, shortest, spread_out
from gnnjax.arm.robot import Robot
from gnnjax.clock import Clock
from gnnjax.collision.checker import Checker
from gnnjax.collision.edges import bisection_order, cut_edges, most_intervals
from gnnjax.devices import platform
from gnnjax.per_object import per_object
from gnnjax.planning.guided import Guided
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import without_points
from gnnjax.search.knowledge import INVALID, UNKNOWN, VALID
from gnnjax.search.rounds import Priced, cheapest_route, learn

SIZES = (64, 256, 1024, 4096, 16_384)  # problems of a batch; one compilation each
_FEW = 32  # problems; so many that have no path yet are not worth another roadmap
_STEPS = 24  # nodes of a path; longer ones are left to the engine
_PASSES, _ROADMAPS, _ROUNDS = 3, 3, 24  # of shortening; of a problem; of a roadmap
# Configurations that are tested at once: as many as caches hold, or as an H100 was fastest with.
_BLOCK, _LARGE_BLOCK = 2048, 262_144
# Configurations of a motion are tested up to these numbers, in the order of bisection, before the
# motions that hold so far are tested further.
_STRATA = (0, 2, 8, 32)


class Motions(NamedTuple):
    """What is to be tested: M motions, or configurations where both ends are the same."""

    owner: Int[Array, " M"]  # the problem whose scene counts
    starts: Float[Array, "M D"]
    ends: Float[Array, "M D"]
    wanted: Bool[Array, " M"]


class Candidates(NamedTuple):
    """Paths of P problems that tests found free; nothing is certified."""

    points: np.ndarray  # [K P T D] the path as it was found, and after each pass of shortening
    num: np.ndarray  # [K P] points of it; 0 without a path
    edge_checks: np.ndarray  # [P]
    configuration_checks: np.ndarray  # [P]


class AbreastSearch:
    """Finds candidates for batches, where functions run at present."""

    def __init__(self, robot: Robot, strategy: Guided, checker: Checker, resolution: float):
        """Args:
        robot: the arm.
        strategy: makes roadmaps; its guide looks at stored ones.
        checker: collision functions.
        resolution: largest distance of neighbouring configurations of a motion.
        """
        self.robot, self.strategy, self.checker = robot, strategy, checker
        self._resolution = resolution
        self._order = bisection_order(most_intervals(robot, resolution)).astype(np.int16)

    def __call__(self, problems: Problem, seed: int) -> Candidates:
        """Candidates for P problems `[P, ...]`."""
        problems = problems._replace(scene=without_points(problems.scene))
        problems = jax.tree.map(np.asarray, problems)
        num, clock = len(problems.start), Clock()
        placed, padded = self._enter(clock, problems)
        holds, *counts = clock.call(self._straight, placed, padded)
        straight = np.where(holds, VALID, INVALID).astype(np.int8)
        route, length, more = self._attempt(clock, placed, padded, straight, seed, 0)
        counts = [np.array(x) + y for x, y in zip(counts, more, strict=True)]
        for number in range(1, _ROADMAPS):
            left = np.flatnonzero(length[:num] == 0)
            if len(left) < _FEW:
                break
            some = jax.tree.map(lambda x, left=left: x[left], problems)
            theirs, some = self._enter(clock, some)
            blocked = np.full(len(some.start), INVALID, np.int8)
            points, found, more = self._attempt(clock, theirs, some, blocked, seed, number)
            route[left], length[left] = points[: len(left)], found[: len(left)]
            for total, x in zip(counts, more, strict=True):
                total[left] += x[: len(left)]
        paths = [(route, length)]
        for _ in range(_PASSES):
            *shorter, counts = clock.call(self._shorten, placed, *paths[-1], tuple(counts))
            paths.append(tuple(shorter))
        every = (np.stack([np.asarray(y)[:num] for y in x]) for x in zip(*paths, strict=True))
        return Candidates(*every, *(np.asarray(x)[:num] for x in counts))

    def _enter(self, clock: Clock, problems: Problem) -> tuple[Any, Problem]:
        """Scenes as tests want them, and problems, as many as one of `SIZES`."""
        num = len(problems.start)
        size = next(size for size in SIZES if num <= size or size == SIZES[-1])
        rows = np.minimum(np.arange(size), num - 1)
        padded = jax.tree.map(lambda x: x[rows], problems)
        return clock.call(self._place, padded.scene), padded

    def _attempt(
        self,
        clock: Clock,
        placed: Any,
        problems: Problem,
        straight: np.ndarray,
        seed: int,
        number: int,
    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Searches one roadmap for each of P problems, in rounds.

        Returns:
            `[P T D]` points, `[P]` their number, 0 without a path, and what was tested.
        """
        num = len(problems.start)
        entered = self.strategy.enter(clock, problems, straight, num, seed, number, self.checker)
        priced, is_line = entered.priced, straight == VALID
        active, counts = ~is_line, (np.zeros(num, np.int32), np.zeros(num, np.int32))
        rounds = 0
        while active.any() and rounds < _ROUNDS:
            priced, active, counts = clock.call(self._round, placed, priced, active, counts)
            rounds += 1
        lines = np.stack([problems.start, problems.goal], axis=1)
        points, length = clock.call(self._found, priced, lines, is_line)
        return np.array(points), np.array(length), (np.asarray(counts[0]), np.asarray(counts[1]))

    @per_object(jax.jit)
    def _place(self, scenes: Any) -> Any:
        return self.checker.place(scenes)

    @per_object(jax.jit)
    def _straight(self, placed: Any, problems: Problem) -> tuple[jax.Array, jax.Array, jax.Array]:
        num = len(problems.start)
        owner = jnp.arange(num)
        motions = Motions(owner, problems.start, problems.goal, jnp.ones(num, bool))
        holds, checks = self._test(placed, motions, num)
        return holds, jnp.ones(num, jnp.int32), checks

    @per_object(jax.jit)
    def _round(
        self, placed: Any, priced: Priced, active: jax.Array, counts: tuple[jax.Array, jax.Array]
    ) -> tuple[Priced, jax.Array, tuple[jax.Array, jax.Array]]:
        """One round of search: a route for each problem, all of it tested."""
        route = jax.vmap(cheapest_route)(priced)
        num, most = route.path.shape
        kept = min(_STEPS, most)
        price = jnp.sum(route.edge_price, axis=1)
        active &= (route.num > 0) & (route.num <= kept) & (price <= self.strategy.give_up)
        node = route.node_unknown[:, :kept] & active[:, None]
        edge = route.edge_unknown[:, :kept] & active[:, None]
        points = route.points[:, :kept]
        following = route.points[:, np.minimum(np.arange(kept) + 1, most - 1)]
        wanted = jnp.stack([node, edge], axis=1)
        starts = jnp.broadcast_to(points[:, None], (num, 2, kept, points.shape[-1]))
        ends = jnp.stack([points, following], axis=1)
        owner = jnp.broadcast_to(jnp.arange(num)[:, None, None], wanted.shape)
        flat = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[3:]), Motions(owner, starts, ends, wanted)
        )
        holds, checks = self._test(placed, flat, num)
        holds = holds.reshape(wanted.shape)
        status = jnp.where(wanted, jnp.where(holds, VALID, INVALID), UNKNOWN).astype(jnp.int8)
        status = jnp.pad(status, ((0, 0), (0, 0), (0, most - kept)))
        known = jax.vmap(learn)(priced, route, status[:, 0], status[:, 1])
        through = jnp.all(holds | ~wanted, axis=(1, 2))
        edges, before = counts
        counts = edges + jnp.sum(edge, axis=1, dtype=jnp.int32), before + checks
        return priced._replace(known=known), active & ~through, counts

    @per_object(jax.jit)
    def _found(
        self, priced: Priced, lines: jax.Array, is_line: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Paths `[P T D]` of which all is known to hold, and how many points they have."""
        route = jax.vmap(cheapest_route)(priced)
        kept = min(_STEPS, route.path.shape[1])
        unknown = jnp.any(route.node_unknown | route.edge_unknown, axis=1)
        num = jnp.where(unknown | (route.num > kept), 0, route.num)
        points = route.points[:, :kept]
        line = jnp.concatenate([lines, jnp.repeat(lines[:, 1:], kept - 2, axis=1)], axis=1)
        points = jnp.where(is_line[:, None, None], line, points)
        return points, jnp.where(is_line, 2, num)

    @per_object(jax.jit)
    def _shorten(
        self,
        placed: Any,
        points: jax.Array,
        num: jax.Array,
        counts: tuple[jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, tuple[jax.Array, jax.Array]]:
        """One pass: the shortest way along all shortcuts between points of each path that hold."""
        bent = (num > 2) & (num <= POINTS)
        spread, edge = jax.vmap(spread_out)(points, num)
        first, second = spread[:, FIRST], spread[:, SECOND]
        # What lies along one edge of the path holds.
        wanted = bent[:, None] & (edge[:, FIRST] != edge[:, SECOND - 1])
        owner = jnp.broadcast_to(jnp.arange(len(num))[:, None], wanted.shape)
        flat = jax.tree.map(
            lambda x: x.reshape(-1, *x.shape[2:]), Motions(owner, first, second, wanted)
        )
        holds, checks = self._test(placed, flat, len(num))
        holds = holds.reshape(wanted.shape) | ~wanted
        lengths = jnp.where(holds, jnp.linalg.norm(second - first, axis=-1), jnp.inf)
        way, steps = jax.vmap(shortest)(lengths)
        shorter = jnp.take_along_axis(spread, way[..., None], axis=1)
        width = points.shape[1]
        shorter = jnp.pad(shorter, ((0, 0), (0, max(0, width - POINTS)), (0, 0)), "edge")
        found = jnp.where(bent[:, None, None], shorter[:, :width], points)
        edges, before = counts
        counts = edges + jnp.sum(wanted, axis=1, dtype=jnp.int32), before + checks
        return found, jnp.where(bent, steps, num), counts

    def _test(self, placed: Any, motions: Motions, num: int) -> tuple[jax.Array, jax.Array]:
        """Which of the wanted motions hold `[M]`, and configurations tested for each of `num`
        problems."""
        owner, starts, ends, wanted = motions
        order = jnp.asarray(self._order)
        block = _BLOCK if platform() == "cpu" else _LARGE_BLOCK
        low, high, intervals, testable = cut_edges(starts, ends, self._resolution, len(order) - 1)
        is_motion = jnp.any(starts != ends, axis=1)
        points = jnp.where(is_motion, intervals - 1, 1)
        bounds = jnp.array((*_STRATA, len(order)), jnp.int32)

        def stratum(s, state):
            holds, checks = state
            begin, end = bounds[s], bounds[s + 1]
            size = jnp.where(wanted & holds, jnp.clip(points - begin, 0, end - begin), 0)
            last = jnp.cumsum(size)

            def some(i, state):
                holds, checks = state
                place = i * block + jnp.arange(block)
                real = place < last[-1]
                motion = jnp.minimum(jnp.searchsorted(last, place, side="right"), len(size) - 1)
                step = begin + place - (last[motion] - size[motion])
                at = jnp.where(
                    is_motion[motion],
                    order[intervals[motion], jnp.clip(step, 0, len(order) - 2)],
                    0,
                )
                fraction = (at / intervals[motion].astype(starts.dtype))[:, None]
                q = low[motion] + fraction * (high[motion] - low[motion])
                whose = jnp.where(real, owner[motion], 0)
                free = self.checker.check_each(placed, whose, q[:, None])[:, 0]
                holds = holds.at[jnp.where(real & ~free, motion, len(size))].set(False, mode="drop")
                return holds, checks.at[jnp.where(real, whose, num)].add(1, mode="drop")

            return jax.lax.fori_loop(0, (last[-1] + block - 1) // block, some, (holds, checks))

        state = testable & wanted, jnp.zeros(num, jnp.int32)
        return jax.lax.fori_loop(0, len(_STRATA), stratum, state)
