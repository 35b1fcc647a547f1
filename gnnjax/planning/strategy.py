"""What tells planners on roadmaps apart: where roadmaps come from, and how one is searched.

A `Strategy` is a few pure functions for one problem; `engine.py` compiles them, runs them over
problems and roadmaps, counts, and certifies what comes out. Here are the strategies that need no
more than a guide or nothing at all; the paper's are in `gnnjax.paper.strategy`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.checker import EdgeChecks
from gnnjax.errors import InputError
from gnnjax.guide.guide import Guide
from gnnjax.planning.options import PlannerOptions
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import Roadmap, default_radius
from gnnjax.roadmap.paths import cost_to_go, edge_validity, follow, next_slots
from gnnjax.roadmap.sampled import SampledRoadmap, sample_roadmap
from gnnjax.roadmap.stored import NUM_LOCAL, add_local_nodes, insert_ends, stored_roadmap
from gnnjax.scene.scene import Scene
from gnnjax.search.greedy import Scorer, distance_scorer, greedy_search, oracle_scorer
from gnnjax.search.guided import search_guided, shorten_guided
from gnnjax.search.knowledge import INVALID, VALID, Found, Knowledge, SearchResult, found_by
from gnnjax.search.lazy import lazy_search
from gnnjax.search.shorten import PATH_POINTS

# nats; a roadmap whose best path is less likely to be free than e^-this waits until all others
# were tried.
GIVE_UP = 4.0

# Nodes of the roadmaps after the first, beside those around the ends, at least and at most: what a
# small one does not solve is hard, and a large one takes long.
_WIDE_NODES = (400, 600)

_ROADMAPS_A_SEED = 1000  # seeds of stored roadmaps: of query seed s, from 1000 s on


class Checks(NamedTuple):
    """The collision checks of one scene, ends of edges apart."""

    edge: Callable[[jax.Array, jax.Array], EdgeChecks]  # `(q_from [D], q_to [D])`
    edges: Callable[[jax.Array, jax.Array], EdgeChecks]  # `(starts [E D], ends [E D])`
    nodes: Callable[[jax.Array], jax.Array]  # `[B D] -> [B]`, true where valid


# `(weights, stored, key, problem, checks) -> SampledRoadmap`
Propose = Callable[[Any, Roadmap | None, jax.Array, Problem, Checks], SampledRoadmap]


class Strategy(NamedTuple):
    """How one problem is planned. Weights are arguments, so that others need no compilation."""

    weights: Any
    radius: float  # of the first roadmap, configuration units
    # `(seed, number)`, on the host: the part of a query's roadmap that is stored, if any.
    stored: Callable[[int, int], Roadmap | None]
    first: Propose  # the first roadmap
    later: Propose  # all others; where they are made like the first, the same function
    # `(weights, roadmap, scene, checks, known, longest_checked, max_price, later)`: the path that
    # is cheapest by what is known, checked if it has no more edges than `longest_checked`; gives up
    # where its price exceeds `max_price` nats. `later` is no array.
    search: Callable[..., tuple[Found, Knowledge]]
    # `(weights, points, scene, checks, status)`: a shorter path, checked; None: none is tried.
    shorten: Callable[..., tuple[Found, jax.Array]] | None
    nodes_checked: bool  # the nodes of its roadmaps are valid
    give_up: float  # nats; `max_price` until all roadmaps were tried
    describe: str  # what a roadmap is, for "no path in the 8 roadmaps tried (...)"

    @property
    def has_later(self) -> bool:
        """Whether later roadmaps are made otherwise than the first."""
        return self.later is not self.first


def guided(robot: Robot, guide: Guide, options: PlannerOptions) -> Strategy:
    """Paths are found and shortened in the eyes of a guide, on roadmaps nobody has checked.

    Roadmap after roadmap is searched for a path that is likely free; only when none of them has one
    are they searched to the end, one after the other. So a path is found wherever one of the
    roadmaps has one.
    """
    num_nodes = options.num_nodes
    if num_nodes < PATH_POINTS:
        raise InputError(f"num_nodes is {num_nodes}; planner 'guided' needs at least {PATH_POINTS}")
    wide = int(np.clip(num_nodes, *_WIDE_NODES))
    radius, wide_radius = default_radius(robot, num_nodes), default_radius(robot, wide)
    limits = robot.joint_lower, robot.joint_upper

    def stored(seed: int, number: int) -> Roadmap:
        size = wide if number else num_nodes
        return stored_roadmap(robot, size - 2, seed * _ROADMAPS_A_SEED + number)

    def first(weights, stored, key, problem: Problem, checks: Checks) -> SampledRoadmap:
        return SampledRoadmap(
            insert_ends(stored, problem.start, problem.goal, radius), jnp.int32(0)
        )

    def later(weights, stored, key, problem: Problem, checks: Checks) -> SampledRoadmap:
        price = guide.prices(weights, problem.scene).nodes
        ends = problem.start, problem.goal
        roadmap = add_local_nodes(key, stored, *ends, wide_radius, limits, price)
        return SampledRoadmap(roadmap, jnp.int32(0))

    def search(
        weights,
        roadmap: Roadmap,
        scene: Scene,
        checks: Checks,
        known: Knowledge,
        longest_checked: jax.Array,
        max_price: jax.Array,
        later: bool,
    ) -> tuple[Found, Knowledge]:
        return search_guided(
            roadmap,
            guide.prices(weights, scene),
            checks.edge,
            checks.nodes,
            known,
            longest_checked,
            max_price,
            price_all=later,
        )

    def shorten(weights, points, scene: Scene, checks: Checks, status: jax.Array):
        prices = guide.prices(weights, scene)
        return shorten_guided(points, prices, checks.edge, checks.nodes, status)

    sampling = _sampling(robot, num_nodes, radius) if options.sampled else None
    return Strategy(
        weights=guide.weights,
        radius=radius,
        stored=(lambda seed, number: None) if options.sampled else stored,
        first=sampling or first,
        later=sampling or later,
        search=search,
        shorten=shorten if options.shorten else None,
        nodes_checked=options.sampled,
        give_up=GIVE_UP,
        describe=f"{num_nodes} nodes, then {wide} and {2 * NUM_LOCAL} around the ends",
    )


def _sampling(robot: Robot, num_nodes: int, radius: float) -> Propose:
    """Roadmaps whose nodes are drawn and tested for the query."""

    def propose(weights, stored, key, problem: Problem, checks: Checks) -> SampledRoadmap:
        ends = problem.start, problem.goal
        return sample_roadmap(key, checks.nodes, robot, *ends, num_nodes=num_nodes, radius=radius)

    return propose


def on_sampled_roadmaps(
    robot: Robot,
    options: PlannerOptions,
    search: Callable[[Any, Roadmap, Scene, Checks, jax.Array], SearchResult],
    weights: Any = None,
) -> Strategy:
    """Each roadmap is drawn and tested for the query, and searched to the end before the next.

    Args:
        robot: the arm.
        options: number of nodes.
        search: `(weights, roadmap, scene, checks, status [N K]) -> SearchResult`.
        weights: its first argument.
    """
    radius = default_radius(robot, options.num_nodes)
    propose = _sampling(robot, options.num_nodes, radius)

    def search_all(
        weights, roadmap: Roadmap, scene, checks, known: Knowledge, longest, max_price, later
    ) -> tuple[Found, Knowledge]:
        result = search(weights, roadmap, scene, checks, known.status)
        return found_by(result, roadmap), known._replace(status=result.edge_status)

    return Strategy(
        weights=weights,
        radius=radius,
        stored=lambda seed, number: None,
        first=propose,
        later=propose,
        search=search_all,
        shorten=None,
        nodes_checked=True,
        give_up=np.inf,
        describe=f"{options.num_nodes} nodes, radius {radius:.2f}",
    )


def greedy(
    robot: Robot, options: PlannerOptions, make_scorer: Callable[[Roadmap, Scene], Scorer]
) -> Strategy:
    """Algorithm 1 of Diao, Chi and Wang with any scorer."""

    def search(weights, roadmap: Roadmap, scene: Scene, checks: Checks, status: jax.Array):
        return greedy_search(roadmap, make_scorer(roadmap, scene), checks.edge, status)

    return on_sampled_roadmaps(robot, options, search)


def distance(robot: Robot, options: PlannerOptions) -> Strategy:
    """Algorithm 1 with the distance to the goal in the network's place."""
    return greedy(robot, options, lambda roadmap, scene: distance_scorer(roadmap))


def lazysp(robot: Robot, options: PlannerOptions) -> Strategy:
    """The edges of the shortest path are checked until one holds (Dellin and Srinivasa, 2016)."""

    def search(weights, roadmap: Roadmap, scene: Scene, checks: Checks, status: jax.Array):
        return lazy_search(roadmap, checks.edge, status)

    return on_sampled_roadmaps(robot, options, search)


def prm(robot: Robot, options: PlannerOptions) -> Strategy:
    """All edges are checked, then the shortest path is taken."""

    def search(weights, roadmap: Roadmap, scene: Scene, checks: Checks, status: jax.Array):
        labelled = edge_validity(roadmap, checks.edges)
        usable = labelled.edge_valid & (status != INVALID)
        edge_cost = jnp.where(usable, roadmap.lengths, jnp.inf)
        cost = cost_to_go(roadmap, edge_cost)
        path = follow(roadmap, next_slots(roadmap, edge_cost, cost), cost)
        # Brute force checks everything the first time and knows it afterwards.
        first = jnp.all(status == 0)
        return SearchResult(
            path,
            jnp.isfinite(cost[0]),
            jnp.where(first, labelled.num_edge_checks, 0),
            jnp.where(first, labelled.num_checks, 0),
            jnp.where(usable, VALID, INVALID).astype(jnp.int8),
        )

    return on_sampled_roadmaps(robot, options, search)


def oracle(robot: Robot, options: PlannerOptions) -> Strategy:
    """Algorithm 1 with the exact cost-to-go, which no planner can know: a bound."""

    def search(weights, roadmap: Roadmap, scene: Scene, checks: Checks, status: jax.Array):
        usable = edge_validity(roadmap, checks.edges).edge_valid & (status != INVALID)
        cost = cost_to_go(roadmap, jnp.where(usable, roadmap.lengths, jnp.inf))
        return greedy_search(roadmap, oracle_scorer(roadmap, cost), checks.edge, status)

    return on_sampled_roadmaps(robot, options, search)
