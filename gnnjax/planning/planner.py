"""Planners: a robot, a strategy, and what was compiled for them."""

import functools
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.certify import check_scene
from gnnjax.devices import cache_compilations
from gnnjax.errors import InputError, check_seed
from gnnjax.guide.guide import Guide
from gnnjax.planning import strategy as strategies
from gnnjax.planning.compiled import Compiled, compile_strategy
from gnnjax.planning.batch import FIRST, LATER, SHORTEN, Batch
from gnnjax.planning.options import PlannerOptions, check_options, make_options
from gnnjax.planning.query import Plan, QueryPlanner, base_clear, check_query
from gnnjax.planning.strategy import Strategy
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import Roadmap
from gnnjax.scene.scene import Scene, is_axis_aligned
from gnnjax.search.greedy import Scorer

# Of `load_planner`: ranks neighbors on one roadmap in one scene.
MakeScorer = Callable[[Roadmap, Scene], Scorer]

# What decides what is compiled: problems at once, padded boxes, and whether none is rotated.
_Shape: TypeAlias = tuple[int, int, bool]


def load_planner(
    robot: str | Path,
    planner: str = "guided",
    *,
    guide: Guide | None = None,
    scorer: MakeScorer | None = None,
    **options: Any,
) -> "Planner":
    """Loads a robot, and weights where they are needed, and makes a planner on roadmaps.

    Args:
        robot: name of a shipped robot, or path of an MJCF.
        planner: one of `PLANNERS`, but for OMPL's, which `evaluate` makes.
        guide: for "guided": your own, in place of the motion network.
        scorer: for "greedy": `(roadmap, scene) -> Scorer`.
        options: see `PlannerOptions`: num_nodes, max_roadmaps, weights, shorten, sampled, checker,
            resolution, time_limit.

    Raises:
        InputError: an unknown robot, planner or option, or options that do not fit the planner.
    """
    return own_planner(load_robot(robot), make_options(planner, **options), guide, scorer)


def own_planner(
    robot: Robot,
    options: PlannerOptions,
    guide: Guide | None = None,
    scorer: MakeScorer | None = None,
) -> "Planner":
    """`make_planner` for all but OMPL's, whose paths nobody certifies before they are returned."""
    made = make_planner(robot, options, guide, scorer)
    if not isinstance(made, Planner):
        raise InputError(
            f"planner {options.planner!r} is one of OMPL's; python -m gnnjax.evaluate takes it"
        )
    return made


def make_planner(
    robot: Robot,
    options: PlannerOptions,
    guide: Guide | None = None,
    scorer: MakeScorer | None = None,
) -> QueryPlanner:
    """The planner that options name; see `load_planner`."""
    check_options(options)
    name = options.planner
    if guide is not None and name != "guided":
        raise InputError(f"a guide with planner {name!r}; only planner 'guided' takes one")
    if (scorer is not None) != (name == "greedy"):
        raise InputError(
            f"planner {name!r} with scorer {scorer}; planner 'greedy' takes one, and only that"
        )
    if options.is_classical:
        from gnnjax.baselines.ompl import ClassicalPlanner

        return ClassicalPlanner(robot, options)
    if name == "guided":
        guide = guide or _motion_guide(robot, options)
        return Planner(robot, strategies.guided(robot, guide, options), options)
    if name in ("gnn", "gnn_lazy"):
        from gnnjax.paper import strategy as paper

        return Planner(robot, paper.from_weights(robot, options), options)
    if scorer is not None:
        return Planner(robot, strategies.greedy(robot, options, scorer), options)
    return Planner(robot, getattr(strategies, name)(robot, options), options)


def _motion_guide(robot: Robot, options: PlannerOptions) -> Guide:
    from gnnjax.guide.motion import MotionNetwork, motion_guide
    from gnnjax.training.weights import load_network_as

    weights = "motion" if options.weights is None else options.weights
    return motion_guide(robot, load_network_as(MotionNetwork, weights, "guided"))


class Planner:
    """Plans queries for one robot on roadmaps.

    Compiles on the first query and keeps the result on disk; `warm_up` does so beforehand.
    """

    def __init__(self, robot: Robot, strategy: Strategy, options: PlannerOptions):
        check_options(options)
        cache_compilations()
        self.robot, self.options = robot, options
        self.strategy = strategy
        # Shapes and parts that are compiled.
        self._warm: set[tuple[int, int, bool, int]] = set()
        self.use_weights(strategy.weights)

    @property
    def radius(self) -> float:
        """Of the first roadmap, configuration units."""
        return self.strategy.radius

    def use_weights(self, weights: Any) -> None:
        """Goes on with other weights of the same network; nothing is compiled again."""
        # Restored weights are bound to a device. So would be all that is computed with them, and
        # JAX would compile anew for what is bound and what is not.
        weights = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), weights)
        self.strategy = self.strategy._replace(weights=weights)

    def plan(self, scene: Scene, start: ArrayLike, goal: ArrayLike, *, seed: int = 0) -> Plan:
        """Finds a certified path from start to goal `[D]`.

        Raises:
            InputError: start or goal is no valid configuration, or a box stands in the base.
        """
        check_scene(scene)
        shape = 1, len(scene.mask), is_axis_aligned(scene)
        if (*shape, FIRST) not in self._warm:
            check_query(self.robot, scene, start, goal)  # refused before a minute of compilation
            self._warm_up(scene, shape, FIRST)
        begin = time.perf_counter()
        start, goal = check_query(self.robot, scene, start, goal)
        checking = time.perf_counter() - begin
        problems = jax.tree.map(lambda x: np.asarray(x)[None], Problem(start, goal, scene))
        plan = self.plan_batch(problems, seed=seed)[0]
        # What checking the query took belongs to it.
        return plan._replace(total_time_s=plan.total_time_s + checking)

    def plan_batch(self, problems: Problem, *, seed: int = 0) -> list[Plan]:
        """Plans P problems at once; every plan is what `plan` finds for its problem.

        Times are shared out equally over the problems that were worked on together.

        Args:
            problems: `[P, ...]`, which `check_query` accepts.
            seed: of the roadmaps; the same for each problem.
        """
        seed = check_seed(seed)
        scene = jax.tree.map(lambda x: x[0], problems.scene)
        # One rotated box in the batch, and all are taken for rotated.
        shape = len(problems.start), len(scene.mask), is_axis_aligned(problems.scene)
        need = functools.partial(self._warm_up, scene, shape)
        return self._batch(problems, shape, seed, need).run()

    def warm_up(self, scene: Scene, batch_size: int = 1) -> None:
        """Compiles all that planning in scenes like this may need, unless that was done before.

        Planning does it by itself, part by part, when a query first comes to it; its times never
        contain compilation.

        Args:
            scene: whose padded number of boxes, and whether one is rotated, are what counts.
            batch_size: problems at once.
        """
        shape = batch_size, len(scene.mask), is_axis_aligned(scene)
        wanted = {
            FIRST: True,
            LATER: self.strategy.has_later and self.options.max_roadmaps > 1,
            SHORTEN: self.strategy.shorten is not None,
        }
        parts = [part for part, is_wanted in wanted.items() if is_wanted]
        # Caches do not keep threads from making the same functions twice, of which one is kept.
        self._compiled(shape[2])
        base_clear(self.robot, scene)
        with ThreadPoolExecutor() as pool:  # side by side: 39 s instead of 52 s on two cores
            list(pool.map(functools.partial(self._warm_up, scene, shape), parts))

    def _warm_up(self, scene: Scene, shape: _Shape, part: int) -> None:
        if (*shape, part) in self._warm:
            return
        base_clear(self.robot, scene)
        num = shape[0]
        ends = np.tile(self.robot.home, (num, 1))
        scenes = jax.tree.map(lambda x: np.broadcast_to(x, (num, *np.shape(x))), scene)
        self._batch(Problem(ends, ends, scenes), shape, 0).warm_up(part)
        self._warm.add((*shape, part))

    def _batch(
        self,
        problems: Problem,
        shape: _Shape,
        seed: int,
        need: Callable[[int], None] | None = None,
    ) -> Batch:
        compiled = self._compiled(shape[2])
        return Batch(self.robot, self.strategy, self.options, compiled, problems, seed, need)

    @functools.cache  # noqa: B019 - a planner lives as long as its compiled functions
    def _compiled(self, axis_aligned: bool) -> Compiled:
        return compile_strategy(self.robot, self.strategy, self.options, axis_aligned)
