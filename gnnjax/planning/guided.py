"""The default planner's roadmaps and shortcuts, in the eyes of a guide."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.guide.guide import RISK_WEIGHT, Guide
from gnnjax.planning.options import PlannerOptions
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import GOAL, START, Roadmap, default_radius
from gnnjax.roadmap.paths import for_each_edge
from gnnjax.roadmap.stored import NUM_LOCAL, add_local_nodes, insert_ends, stored_roadmap
from gnnjax.search.knowledge import UNKNOWN, VALID, Knowledge
from gnnjax.search.rounds import Priced
from gnnjax.search.shorten import PATH_POINTS, shortened, spread_along

# Most pieces that a motion is looked at in; the longest edge is that from start to goal.
EDGE_PIECES, SHORTCUT_PIECES, ALL_PIECES = 16, 12, 8

_WIDE_NODES = (400, 600)
_ROADMAPS_A_SEED = 1000  # seeds of stored roadmaps: of query seed s, from 1000 s on


class Guided:
    """Roadmaps nobody has checked, priced by a guide."""

    def __init__(self, robot: Robot, guide: Guide, options: PlannerOptions):
        num_nodes = options.num_nodes
        if num_nodes < PATH_POINTS:
            raise InputError(
                f"num_nodes is {num_nodes}; planner 'guided' needs at least {PATH_POINTS}"
            )
        self.robot, self.guide, self.options = robot, guide, options
        self.weights = guide.weights
        wide = int(np.clip(num_nodes, *_WIDE_NODES))
        self.sizes = num_nodes, wide
        self.radius, self.wide_radius = (default_radius(robot, n) for n in self.sizes)
        self.describe = f"{num_nodes} nodes, then {wide} and {2 * NUM_LOCAL} around the ends"

    def enter(
        self, call: Any, problems: Problem, direct: np.ndarray, seed: int, number: int
    ) -> tuple[Priced, Any]:
        """Roadmaps of B problems, priced, and what the guide reads of their scenes."""
        stored, table = self._stored(seed, number)
        if number == 0:
            return call(self._first, self.weights, stored, table, problems, direct)
        key = jax.random.fold_in(jax.random.key(seed), number)
        return call(self._later, self.weights, stored, key, problems, direct)

    @functools.lru_cache(maxsize=32)
    def _stored(self, seed: int, number: int) -> tuple[Roadmap, Any]:
        size = self.sizes[min(number, 1)]
        stored = stored_roadmap(self.robot, size - 2, seed * _ROADMAPS_A_SEED + number)
        tabulate = self.guide.tabulate
        return stored, tabulate(stored) if tabulate is not None and number == 0 else None

    @functools.partial(jax.jit, static_argnums=0)
    def _first(self, weights, stored, table, problems: Problem, direct) -> tuple[Priced, Any]:
        guide = self.guide

        def with_ends(problem: Problem) -> tuple[Roadmap, Any]:
            roadmap = insert_ends(stored, problem.start, problem.goal, self.radius)
            return roadmap, guide.read(weights, problem.scene)

        roadmaps, readings = jax.vmap(with_ends)(problems)
        if guide.stored is None:

            def rough(roadmap: Roadmap, reading: Any) -> jax.Array:
                at_node = guide.prices(weights, reading).nodes(roadmap.nodes)
                at_node = at_node.at[: GOAL + 1].set(0.0)  # start and goal are valid
                return (at_node[:, None] + at_node[roadmap.neighbors]) / 2

            price = jax.vmap(rough)(roadmaps, readings)
        else:
            inner = guide.stored(weights, readings, table)

            def joined(roadmap: Roadmap, reading: Any, inner: jax.Array) -> jax.Array:
                num, num_slots = roadmap.neighbors.shape
                near = roadmap.neighbors[: GOAL + 1]
                starts = jnp.repeat(roadmap.nodes[: GOAL + 1], num_slots, axis=0)
                ends = roadmap.nodes[near.ravel()]
                motions = guide.prices(weights, reading).motions
                own = motions(starts, ends, EDGE_PIECES).reshape(near.shape)
                own = jnp.where(roadmap.neighbor_mask[: GOAL + 1], own, 0.0)
                own = own.at[GOAL, 0].set(own[START, 0])
                price = jnp.pad(inner, ((2, 0), (0, 2))).at[: GOAL + 1].set(own)
                for end in (START, GOAL):
                    column = jnp.zeros(num).at[near[end]].max(own[end])
                    price = price.at[2:, num_slots - 2 + end].set(column[2:])
                return price

            price = jax.vmap(joined)(roadmaps, readings, inner)
        return self._priced(roadmaps, price, direct, judged=guide.stored is not None), readings

    @functools.partial(jax.jit, static_argnums=0)
    def _later(self, weights, stored, key, problems: Problem, direct) -> tuple[Priced, Any]:
        guide = self.guide
        limits = self.robot.joint_lower, self.robot.joint_upper

        def one(problem: Problem) -> tuple[Roadmap, Any, jax.Array]:
            reading = guide.read(weights, problem.scene)
            prices = guide.prices(weights, reading)
            ends = problem.start, problem.goal
            roadmap = add_local_nodes(key, stored, *ends, self.wide_radius, limits, prices.nodes)
            every = for_each_edge(roadmap, lambda a, b: prices.motions(a, b, ALL_PIECES))
            return roadmap, reading, every

        roadmaps, readings, price = jax.lax.map(one, problems)
        return self._priced(roadmaps, price, direct, judged=True), readings

    def _priced(self, roadmaps: Roadmap, price: jax.Array, direct: jax.Array, judged: bool) -> Priced:
        status = jnp.zeros(roadmaps.neighbors.shape, jnp.int8)
        is_direct = jnp.stack(
            [roadmaps.neighbors[:, START] == GOAL, roadmaps.neighbors[:, GOAL] == START], axis=1
        )
        status = status.at[:, : GOAL + 1].set(
            jnp.where(is_direct, direct[:, None, None].astype(jnp.int8), UNKNOWN)
        )
        node_status = jnp.zeros(roadmaps.node_mask.shape, jnp.int8).at[:, : GOAL + 1].set(VALID)
        return Priced(
            roadmaps, RISK_WEIGHT * price, jnp.full(price.shape, judged), Knowledge(status, node_status)
        )

    @functools.partial(jax.jit, static_argnums=0)
    def judge(self, weights, readings, starts: jax.Array, ends: jax.Array) -> jax.Array:
        """Prices of motions `[B E]`."""

        def one(reading: Any, starts: jax.Array, ends: jax.Array) -> jax.Array:
            motions = self.guide.prices(weights, reading).motions
            return RISK_WEIGHT * motions(starts, ends, EDGE_PIECES)

        return jax.vmap(one)(readings, starts, ends)

    @functools.partial(jax.jit, static_argnums=0)
    def shortcuts(self, weights, readings, lines: jax.Array) -> Priced:
        """Path roadmaps of paths `[B N D]` that are shortened in the guide's eyes, priced."""

        def one(reading: Any, line: jax.Array) -> Priced:
            motions = self.guide.prices(weights, reading).motions
            roadmap, price = shortened(
                spread_along(line, PATH_POINTS),
                lambda a, b: RISK_WEIGHT * motions(a, b, SHORTCUT_PIECES),
            )
            nodes = jnp.zeros(PATH_POINTS, jnp.int8).at[: GOAL + 1].set(VALID)
            known = Knowledge(jnp.zeros(price.shape, jnp.int8), nodes)
            return Priced(roadmap, price, jnp.ones(price.shape, bool), known)

        return jax.vmap(one)(readings, lines)
