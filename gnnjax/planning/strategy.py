"""What tells planners on sampled roadmaps apart: how one is searched.

A `Strategy` is a few pure functions for one problem; `sampled_search.py` compiles them, runs them
over problems and roadmaps, counts, and certifies what comes out. Here are the strategies that need
no network; the paper's are in `gnnjax.paper.strategy`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gnnjax.arm.robot import Robot
from gnnjax.collision.edges import EdgeChecks
from gnnjax.planning.options import PlannerOptions
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import START, Roadmap, default_radius
from gnnjax.roadmap.paths import cost_to_go, edge_validity, follow, next_slots
from gnnjax.roadmap.sampled import SampledRoadmap, sample_roadmap
from gnnjax.scene.scene import Scene
from gnnjax.search.greedy import Scorer, distance_scorer, greedy_search, oracle_scorer
from gnnjax.search.knowledge import INVALID, UNKNOWN, VALID, SearchResult
from gnnjax.search.lazy import lazy_search


class Checks(NamedTuple):
    """The collision checks of one scene, ends of edges apart."""

    edge: Callable[[jax.Array, jax.Array], EdgeChecks]  # `(q_from [D], q_to [D])`
    edges: Callable[[jax.Array, jax.Array], EdgeChecks]  # `(starts [E D], ends [E D])`
    nodes: Callable[[jax.Array], jax.Array]  # `[B D] -> [B]`, true where valid


class Strategy(NamedTuple):
    """How one problem is planned. Weights are arguments, so that others need no compilation."""

    weights: Any
    radius: float  # of a roadmap, configuration units
    propose: Callable[[jax.Array, Problem, Checks], SampledRoadmap]  # `(key, problem, checks)`
    # `(weights, roadmap, scene, checks, status [N K]) -> SearchResult`
    search: Callable[[Any, Roadmap, Scene, Checks, jax.Array], SearchResult]
    describe: str  # what a roadmap is, for "no path in the 8 roadmaps tried (...)"

    def with_weights(self, weights: Any) -> "Strategy":
        """The same with other weights."""
        return self._replace(weights=weights)


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
    num_nodes = options.num_nodes
    radius = default_radius(robot, num_nodes)

    def propose(key: jax.Array, problem: Problem, checks: Checks) -> SampledRoadmap:
        ends = problem.start, problem.goal
        return sample_roadmap(key, checks.nodes, robot, *ends, num_nodes=num_nodes, radius=radius)

    describe = f"{num_nodes} nodes, radius {radius:.2f}"
    return Strategy(weights, radius, propose, search, describe)


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
        first = jnp.all(status == UNKNOWN)
        return SearchResult(
            path,
            jnp.isfinite(cost[START]),
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
