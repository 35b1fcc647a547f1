"""The default planner's roadmaps, in the eyes of a guide."""

import copy
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.clock import Clock
from gnnjax.collision.checker import Checker
from gnnjax.devices import map_first
from gnnjax.errors import InputError
from gnnjax.guide.guide import RISK_WEIGHT, Guide
from gnnjax.kept import keep
from gnnjax.per_object import per_object
from gnnjax.planning.looks import EDGE_PIECES, LOCAL_PIECES, Looks
from gnnjax.planning.options import PlannerOptions
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import GOAL, START, Roadmap, default_radius
from gnnjax.roadmap.paths import for_each_edge, for_wanted_edges
from gnnjax.roadmap.sampled import sample_roadmap
from gnnjax.roadmap.stored import (
    NUM_LOCAL,
    add_local_nodes,
    compiled_offsets,
    insert_ends,
    stored_roadmap,
)
from gnnjax.search.knowledge import UNKNOWN, ends_known
from gnnjax.search.path_roadmap import PATH_POINTS
from gnnjax.search.rounds import Priced, keep_cheapest

JUDGED = 16  # edges of a path that are looked at in a round

# nats; a roadmap whose best path is less likely to be free than e^-this waits until others were
# tried.
GIVE_UP = 4.0

_SLOTS = 16  # edges that a search may leave a node by

_WIDE_NODES = (400, 600)
_ROADMAPS_A_SEED = 1000  # seeds of stored roadmaps: of query seed s, from 1000 s on


class Entered(NamedTuple):
    """Problems that enter a pool, `[B]`."""

    priced: Priced
    reading: Any  # what the guide read of the scenes
    num_checks: jax.Array  # [B] configurations tested for the roadmaps


class Guided:
    """Roadmaps nobody has checked, priced by a guide.

    Functions are for B problems, of which the first `num` count.
    """

    def __init__(self, robot: Robot, guide: Guide, options: PlannerOptions):
        """Args:
        robot: the arm.
        guide: prices motions.
        options: number of nodes, and whether they are sampled, and paths shortened.
        """
        num_nodes = options.num_nodes
        if num_nodes < PATH_POINTS:
            raise InputError(
                f"num_nodes is {num_nodes}; planner 'guided' needs at least {PATH_POINTS}"
            )
        self.robot, self.guide, self.options = robot, guide, options
        self.looks = Looks(guide)
        self.weights, self.shorten = guide.weights, options.shorten
        wide = int(np.clip(num_nodes, *_WIDE_NODES))
        self._sizes = num_nodes, wide
        self.radius, self._wide_radius = (default_radius(robot, n) for n in self._sizes)
        self.give_up = GIVE_UP
        self.describe = f"{num_nodes} nodes, then {wide} and {2 * NUM_LOCAL} around the ends"
        if options.sampled:
            self.describe = f"{num_nodes} nodes, radius {self.radius:.2f}"

    @property
    def is_judged(self) -> bool:
        """Whether all prices are final when a problem enters."""
        return self.guide.stored is not None or self.options.sampled

    def with_weights(self, weights: Any) -> "Guided":
        """The same with other weights, and the same compiled functions."""
        other = copy.copy(self)
        other.weights = weights
        return other

    def most_slots(self, number: int) -> int:
        """Of a pool; larger roadmaps leave the caches."""
        return 64 if number or self.options.num_nodes > 400 else 256

    def enter(
        self,
        clock: Clock,
        problems: Problem,
        straight: np.ndarray,
        num: int,
        seed: int,
        number: int,
        checker: Checker,
    ) -> Entered:
        """Roadmaps of problems, priced.

        Args:
            clock: of the run.
            problems: `[B]`.
            straight: `[B]` status of the straight lines from starts to goals.
            num: how many of them count.
            seed: of the query.
            number: of the roadmap, from 0 on.
            checker: tests nodes where those are sampled.
        """
        count = np.int32(num)
        if self.options.sampled:
            key = jax.random.fold_in(jax.random.key(seed), number)
            return clock.call(self._sampled, self.weights, key, problems, straight, count, checker)
        stored, table, offsets = clock.remembered(self.stored, seed, number)
        own = (self.weights, stored, table)
        if number == 0:
            return clock.call(self._first, *own, problems, straight, count)
        return clock.call(self._later, *own, offsets, problems, straight, count)

    @per_object(functools.lru_cache(maxsize=32))
    def stored(self, seed: int, number: int) -> tuple[Roadmap, Any, jax.Array]:
        """The stored roadmap of an attempt, what the guide has tabulated of its edges, and where
        nodes are added around the ends."""
        size = self._sizes[min(number, 1)]
        stored = stored_roadmap(self.robot, size - 2, seed * _ROADMAPS_A_SEED + number)
        tabulate = self.guide.tabulate
        offsets = compiled_offsets(self.robot.num_dof)(np.uint32(seed), np.uint32(number))
        offsets = jax.block_until_ready(offsets)
        return stored, None if tabulate is None else tabulate(stored), offsets

    @per_object(functools.partial(jax.jit, static_argnums=5))
    def _sampled(self, weights, key, problems: Problem, straight, num, checker: Checker) -> Entered:
        """Roadmaps of nodes that are tested, like those of other planners."""

        def one(problem: Problem) -> tuple[Roadmap, jax.Array, Any, jax.Array]:
            reading = self.looks.read_one(weights, problem.scene)
            motions = self.guide.prices(weights, reading).motions
            sampled = sample_roadmap(
                key,
                functools.partial(checker.check_configurations, problem.scene),
                self.robot,
                problem.start,
                problem.goal,
                num_nodes=self.options.num_nodes,
                radius=self.radius,
            )
            price = for_each_edge(sampled.roadmap, lambda a, b: motions(a, b, EDGE_PIECES))
            return sampled.roadmap, price, reading, sampled.num_checks

        roadmaps, price, readings, checks = map_first(one, num, problems)
        priced = self._priced(roadmaps, price, straight, num, judged=True, nodes_checked=True)
        return Entered(priced, readings, checks)

    @per_object(keep)
    def _first(self, weights, stored, table, problems: Problem, straight, num) -> Entered:
        guide = self.guide

        def with_ends(problem: Problem) -> tuple[Roadmap, Any]:
            roadmap = insert_ends(stored, problem.start, problem.goal, self.radius)
            return roadmap, self.looks.read_one(weights, problem.scene)

        roadmaps, readings = map_first(with_ends, num, problems)
        if guide.stored is None:

            def rough(turn: tuple[Roadmap, Any]) -> jax.Array:
                roadmap, reading = turn
                at_node = guide.prices(weights, reading).nodes(roadmap.nodes)
                at_node = at_node.at[: GOAL + 1].set(0.0)  # start and goal are valid
                return (at_node[:, None] + at_node[roadmap.neighbors]) / 2

            price = map_first(rough, num, (roadmaps, readings))
        else:
            inner = guide.stored(weights, readings, table)

            def joined(turn: tuple[Roadmap, Any, jax.Array]) -> jax.Array:
                roadmap, reading, inner = turn
                num_nodes, num_slots = roadmap.neighbors.shape
                near = roadmap.neighbors[: GOAL + 1]
                starts = jnp.repeat(roadmap.nodes[: GOAL + 1], num_slots, axis=0)
                ends = roadmap.nodes[near.ravel()]
                motions = guide.prices(weights, reading).motions
                own = motions(starts, ends, EDGE_PIECES).reshape(near.shape)
                own = jnp.where(roadmap.neighbor_mask[: GOAL + 1], own, 0.0)
                own = own.at[GOAL, 0].set(own[START, 0])
                price = jnp.pad(inner, ((2, 0), (0, 2))).at[: GOAL + 1].set(own)
                for end in (START, GOAL):
                    column = jnp.zeros(num_nodes).at[near[end]].max(own[end])
                    price = price.at[2:, num_slots - 2 + end].set(column[2:])
                return price

            price = map_first(joined, num, (roadmaps, readings, inner))
        judged = guide.stored is not None
        priced = self._priced(roadmaps, price, straight, num, judged=judged)
        return Entered(priced, readings, jnp.zeros(len(price), jnp.int32))

    @per_object(keep)
    def _later(self, weights, stored, table, offsets, problems: Problem, straight, num) -> Entered:
        guide = self.guide
        limits = self.robot.joint_lower, self.robot.joint_upper
        num_special, (num_stored, num_slots) = 2 + 2 * NUM_LOCAL, stored.neighbors.shape
        readings = map_first(lambda x: self.looks.read_one(weights, x), num, problems.scene)
        if guide.stored is None:

            def every(reading: Any) -> jax.Array:
                motions = guide.prices(weights, reading).motions
                return for_each_edge(stored, lambda a, b: motions(a, b, LOCAL_PIECES))

            inner = map_first(every, num, readings)
        else:
            inner = guide.stored(weights, readings, table)

        def one(turn: tuple[Problem, Any, jax.Array]) -> tuple[Roadmap, jax.Array]:
            problem, reading, inner = turn
            prices = guide.prices(weights, reading)
            ends = problem.start, problem.goal
            roadmap = add_local_nodes(
                offsets, stored, *ends, self._wide_radius, limits, prices.nodes
            )
            # Edges of special nodes, from the smaller node; the others are stored.
            near = roadmap.neighbors[:num_special]
            own = jnp.arange(num_special)[:, None]
            wanted = roadmap.neighbor_mask[:num_special] & (own < near)
            found = for_wanted_edges(
                roadmap.nodes, near, wanted, lambda a, b: prices.motions(a, b, LOCAL_PIECES)
            )
            whole = jnp.zeros((num_special, len(roadmap.nodes))).at[own, near].max(found)
            both = whole.at[:, :num_special].max(whole[:, :num_special].T)
            stored_near = roadmap.neighbors[num_special:, num_slots:]
            column = jnp.arange(num_special, num_special + num_stored)[:, None]
            beside = jnp.where(
                stored_near < num_special,
                both[jnp.minimum(stored_near, num_special - 1), column],
                0.0,
            )
            price = jnp.concatenate([both[own, near], jnp.concatenate([inner, beside], axis=1)])
            return roadmap, price

        roadmaps, price = map_first(one, num, (problems, readings, inner))
        priced = self._priced(roadmaps, price, straight, num, judged=True)
        return Entered(priced, readings, jnp.zeros(len(price), jnp.int32))

    def _priced(
        self,
        roadmaps: Roadmap,
        price: jax.Array,
        straight: jax.Array,
        num: jax.Array,
        *,
        judged: bool,
        nodes_checked: bool = False,
    ) -> Priced:
        known = jax.vmap(functools.partial(ends_known, nodes_checked=nodes_checked))(roadmaps)
        is_straight = jnp.stack(
            [roadmaps.neighbors[:, START] == GOAL, roadmaps.neighbors[:, GOAL] == START], axis=1
        )
        status = known.status.at[:, : GOAL + 1].set(
            jnp.where(is_straight, straight[:, None, None].astype(jnp.int8), UNKNOWN)
        )
        judged_edges = jnp.full(price.shape, judged)
        priced = Priced(roadmaps, RISK_WEIGHT * price, judged_edges, known._replace(status=status))
        cheapest = functools.partial(keep_cheapest, num_slots=_SLOTS)
        # On checked nodes searches are compared, so that all of them need all edges.
        return priced if nodes_checked else map_first(cheapest, num, priced)
