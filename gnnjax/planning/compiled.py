"""A strategy's functions, compiled over the problems of a batch."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gnnjax.arm.robot import Robot
from gnnjax.collision.checker import EdgeChecks, make_checker
from gnnjax.devices import over_problems
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.strategy import Checks, Propose, Strategy
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import Roadmap
from gnnjax.roadmap.sampled import SampledRoadmap
from gnnjax.scene.scene import Scene
from gnnjax.search.knowledge import Found, Knowledge, nothing_known


class Compiled(NamedTuple):
    """A strategy's functions over P problems, compiled on their first call.

    `first` and `later`: `(weights, stored, key, problems, active)`; `search`: `(weights, roadmaps,
    scenes, knowledge, longest_checked, max_price, active, later)`; `shorten`: `(weights, points,
    scenes, status, active)`.
    """

    first: Callable
    later: Callable
    search: Callable
    shorten: Callable


def compile_strategy(
    robot: Robot, strategy: Strategy, options: PlannerOptions, axis_aligned: bool
) -> Compiled:
    """Makes the jitted parts of a query."""
    checker = make_checker(
        robot,
        options.checker,
        axis_aligned=axis_aligned,
        resolution=options.resolution,
    )

    def checks_in(scene: Scene) -> Checks:
        def check_edge(start: jax.Array, end: jax.Array) -> EdgeChecks:
            checks = checker.check_edges(scene, start[None], end[None])
            return EdgeChecks(checks.valid[0], checks.num_checks[0])

        return Checks(
            check_edge,
            functools.partial(checker.check_edges, scene),
            functools.partial(checker.check_configurations, scene),
        )

    def build(propose: Propose) -> Callable:
        @jax.jit
        def built(weights, stored, key, problems: Problem, active: jax.Array):
            def one(problem: Problem) -> tuple[SampledRoadmap, Knowledge]:
                sampled = propose(weights, stored, key, problem, checks_in(problem.scene))
                known = nothing_known(sampled.roadmap, nodes_checked=strategy.nodes_checked)
                return sampled, known

            return over_problems(one, active, problems)

        return built

    @functools.partial(jax.jit, static_argnames="later")
    def search(
        weights, roadmaps, scenes, knowledge, longest, max_price, active, later: bool
    ) -> tuple[Found, Knowledge]:
        def one(roadmap: Roadmap, scene: Scene, known: Knowledge):
            checks = checks_in(scene)
            return strategy.search(
                weights, roadmap, scene, checks, known, longest, max_price, later
            )

        found, known = over_problems(one, active, roadmaps, scenes, knowledge)
        return found, _update(active, known, knowledge)

    @jax.jit
    def shorten(weights, points, scenes, status, active) -> tuple[Found, jax.Array]:
        own = strategy.shorten
        assert own is not None

        def one(points: jax.Array, scene: Scene, status: jax.Array):
            return own(weights, points, scene, checks_in(scene), status)

        found, known = over_problems(one, active, points, scenes, status)
        return found, _update(active, known, status)

    first = build(strategy.first)
    later = first if strategy.later is strategy.first else build(strategy.later)
    return Compiled(first, later, search, shorten)


def _update(rows: jax.Array, new: Any, old: Any) -> Any:
    """The new values where `rows` `[P]`, and the old ones elsewhere."""
    return jax.tree.map(
        lambda x, y: jnp.where(rows.reshape(-1, *[1] * (x.ndim - 1)), x, y), new, old
    )
