"""Problems on sampled roadmaps: roadmap after roadmap is drawn and searched, one problem after the
other inside of one compiled function, until a path is certified.

A path that cannot be certified is searched around, never returned.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.checker import make_checker
from gnnjax.collision.edges import EdgeChecks
from gnnjax.devices import map_first, marked_first
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.progress import Limits, Progress
from gnnjax.planning.query import Plan
from gnnjax.planning.strategy import Checks, Strategy
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import GOAL, Roadmap
from gnnjax.roadmap.sampled import SampledRoadmap
from gnnjax.scene.scene import Scene
from gnnjax.search.knowledge import INVALID, SearchResult, unknown_edges


class CompiledStrategy(NamedTuple):
    """A strategy's functions over P problems, compiled on their first call.

    `propose`: `(key, problems, rows, num)`; `search`: `(weights, roadmaps, scenes, status, rows,
    num)`; what is asked about are the first `num` of some rows.
    """

    propose: Callable
    search: Callable


def compile_strategy(
    robot: Robot, strategy: Strategy, options: PlannerOptions, axis_aligned: bool
) -> CompiledStrategy:
    """Makes the jitted parts of a query."""
    checker = make_checker(
        robot, options.checker, axis_aligned=axis_aligned, resolution=options.resolution
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

    @jax.jit
    def propose(
        key: jax.Array, problems: Problem, rows: jax.Array, num: jax.Array
    ) -> SampledRoadmap:
        def one(problem: Problem) -> SampledRoadmap:
            return strategy.propose(key, problem, checks_in(problem.scene))

        return map_first(one, num, problems, rows)

    @jax.jit
    def search(weights, roadmaps, scenes, status, rows, num) -> tuple[SearchResult, jax.Array]:
        def one(turn: tuple[Roadmap, Scene, jax.Array]) -> tuple[SearchResult, jax.Array]:
            roadmap, scene, status = turn
            found = strategy.search(weights, roadmap, scene, checks_in(scene), status)
            return found, roadmap.nodes[jnp.where(found.path >= 0, found.path, GOAL)]

        return map_first(one, num, (roadmaps, scenes, status), rows)

    return CompiledStrategy(propose, search)


class SampledSearch(Progress):
    """P problems on their way."""

    def __init__(
        self,
        robot: Robot,
        strategy: Strategy,
        options: PlannerOptions,
        limits: Limits,
        compiled: CompiledStrategy,
        problems: Problem,
        seed: int,
    ):
        """Args:
        robot: the arm.
        strategy: how a problem is planned.
        options: how much is tried.
        limits: of each problem.
        compiled: the strategy's functions.
        problems: `[P, ...]`, which `check_query` accepts.
        seed: of the roadmaps.
        """
        # Of few sizes, one compilation each: some problems more than once, which nobody plans.
        self._num = len(problems.start)
        repeated = np.resize(np.arange(self._num), 1 << (self._num - 1).bit_length())
        problems = jax.tree.map(lambda x: np.asarray(x)[repeated], problems)
        super().__init__(robot, problems, limits)
        self._is_own = np.arange(len(repeated)) < self._num
        self.strategy, self.options = strategy, options
        self.compiled, self.seed = compiled, seed

    def run(self) -> list[Plan]:
        """Plans all problems."""
        for number in range(1 if self.limits.is_hasty else self.options.max_roadmaps):
            open_ = self.open() & self._is_own
            if not open_.any():
                break
            self._work(self._begin(number, open_), open_)
        plans = self.plans(
            [
                self.given_up(
                    i, f"no path in the {roadmaps} roadmaps tried ({self.strategy.describe})"
                )
                for i, roadmaps in enumerate(self.roadmaps)
            ]
        )
        return plans[: self._num]

    def warm_up(self) -> None:
        """Compiles all that planning needs, and plans nothing."""
        nobody = np.zeros(len(self.paths), bool)
        roadmaps = self._begin(0, nobody)
        self._search(roadmaps, jax.vmap(unknown_edges)(roadmaps), nobody)

    def _begin(self, number: int, rows: np.ndarray) -> Roadmap:
        """The roadmaps of an attempt."""
        begin = self.clock.now()
        key = jax.random.fold_in(jax.random.key(self.seed), number)
        sampled = jax.block_until_ready(
            self.clock.call(self.compiled.propose, key, self.problems, *marked_first(rows))
        )
        self.spend(np.flatnonzero(rows), begin, planning=False)
        self.sampling_checks += np.where(rows, sampled.num_checks, 0)
        self.roadmaps += rows
        return sampled.roadmap

    def _work(self, roadmaps: Roadmap, rows: np.ndarray) -> None:
        """Searches roadmaps until paths are certified, or there are none."""
        begin, open_ = self.clock.now(), rows.copy()
        status = jax.vmap(unknown_edges)(roadmaps)
        while open_.any():
            found, waypoints = self._search(roadmaps, status, open_)
            status = np.array(found.edge_status)
            open_ &= np.asarray(found.success)
            ids = np.flatnonzero(open_)
            walks = [walk[walk >= 0] for walk in np.asarray(found.path)[ids]]
            paths = [np.asarray(waypoints)[i][: len(w)] for i, w in zip(ids, walks, strict=True)]
            certified = self.certify(ids, paths)
            for i, walked, good in zip(ids, walks, certified, strict=True):
                open_[i] = not good.all()
                for step in np.flatnonzero(~good):
                    for near, far in (walked[[step, step + 1]], walked[[step + 1, step]]):
                        slots = np.asarray(roadmaps.neighbors)[i, near] == far
                        status[i, near, slots] = INVALID
        self.spend(np.flatnonzero(rows), begin)

    def _search(
        self, roadmaps: Roadmap, status: Any, rows: np.ndarray
    ) -> tuple[SearchResult, jax.Array]:
        found, waypoints = jax.block_until_ready(
            self.clock.call(
                self.compiled.search,
                self.strategy.weights,
                roadmaps,
                self.problems.scene,
                status,
                *marked_first(rows),
            )
        )
        self.edge_checks += np.where(rows, found.edge_checks, 0)
        self.search_checks += np.where(rows, found.configuration_checks, 0)
        return found, waypoints
