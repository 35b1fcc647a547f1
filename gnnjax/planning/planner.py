"""Planners: a robot, a strategy, and what was compiled for them."""

import abc
import functools
import time
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.collision.bounds import compile_certificates
from gnnjax.collision.checker import make_checker
from gnnjax.collision.margins import proven_clearance
from gnnjax.collision.sequences import SequenceTester
from gnnjax.devices import Share, on_host, shares_of, side_by_side
from gnnjax.errors import InputError, check_seed
from gnnjax.per_object import per_object
from gnnjax.planning.batch import Batch
from gnnjax.planning.engine import Run
from gnnjax.planning.goals import find_goals, plan_to_cheapest
from gnnjax.planning.guided import Guided
from gnnjax.planning.motions import motion_options, with_motions
from gnnjax.planning.options import PlannerOptions, check_options
from gnnjax.planning.progress import Limits
from gnnjax.planning.query import Plan, plan_valid
from gnnjax.planning.sampled_search import CompiledStrategy, SampledSearch, compile_strategy
from gnnjax.planning.strategy import Strategy
from gnnjax.pose.goal import PoseGoal, check_goal
from gnnjax.pose.inverse import prepare
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import Scene, inflated, is_axis_aligned
from gnnjax.trajectory.options import MotionOptions


class Planner(abc.ABC):
    """Plans queries for one robot, on roadmaps or by trees.

    Compiles on the first query and keeps the result on disk; `warm_up` does so beforehand. Searches
    make many small calls, and run on the host's cores also where JAX has an accelerator.
    """

    def __init__(
        self,
        robot: Robot,
        strategy: Guided | Strategy,
        options: PlannerOptions,
        given: dict[str, Any] | None = None,
    ):
        """Args:
        robot: the arm.
        strategy: how a problem is planned.
        options: limits.
        given: what `make_planner` was given besides.
        """
        check_options(options)
        self.given = given or {}
        self.robot, self.strategy, self.options = robot, strategy, options
        self.use_weights(strategy.weights)

    @property
    def radius(self) -> float:
        """Of the first roadmap, configuration units."""
        return self.strategy.radius

    @on_host()
    def use_weights(self, weights: Any) -> None:
        """Goes on with other weights of the same network; nothing is compiled again."""
        # Restored weights are bound to a device. So would be all that is computed with them, and
        # JAX would compile anew for what is bound and what is not.
        weights = jax.tree.map(lambda x: jax.device_put(np.asarray(x)), weights)
        self.strategy = self.strategy.with_weights(weights)

    @on_host()
    def plan(
        self,
        scene: Scene,
        start: ArrayLike,
        goal: ArrayLike | None = None,
        *,
        goals: ArrayLike | None = None,
        goal_pose: PoseGoal | None = None,
        seed: int = 0,
        trajectory: bool | MotionOptions = False,
    ) -> Plan:
        """Finds a certified path from start to goal `[D]`, and the motion along it if wanted.

        In place of a goal there may be several, `goals` `[G D]`, of which any will do, or the pose
        of a frame of the arm. The eight nearest to the start are then tried, and the cheapest path
        is taken; checks and times are those of all of them.

        With `trajectory`, `plan.trajectory` is the fastest motion along the path (`time_path`):
        within the limits of the model, or those given, and with the planner's margin all along the
        curve. It is None where there is no path, and tells why where there is no motion.

        Raises:
            InputError: start or goal is no valid configuration, or no valid one reaches the pose; a
                obstacle stands in the base; limits of a motion that are missing or not positive.
        """
        motion = motion_options(self.robot, trajectory)
        margin, seed = self.options.margin, check_seed(seed)
        compile_certificates(self.robot)  # times hold no compilation
        if goal_pose is not None:
            check_goal(goal_pose)
            prepare(self.robot, goal_pose.frame)
        begin = time.perf_counter()
        start, ends = find_goals(self.robot, scene, start, goal, goals, goal_pose, margin, seed)
        checking = time.perf_counter() - begin
        scenes = jax.tree.map(lambda x: np.asarray(x)[None], scene)
        thick = inflated(scenes, margin)

        def attempt(end: np.ndarray, limits: Limits) -> Plan:
            return self._plan_batch(Problem(start[None], end[None], thick), seed, limits)[0]

        plan = plan_to_cheapest(attempt, start, ends, self.options.time_limit)
        (plan,) = with_motions(self.robot, [plan], scenes, motion, margin)
        # What checking the query took belongs to it.
        return plan._replace(total_time_s=plan.total_time_s + checking)

    @on_host()
    def plan_batch(
        self, problems: Problem, *, seed: int = 0, trajectory: bool | MotionOptions = False
    ) -> list[Plan]:
        """Plans P problems at once; every plan is what `plan` finds for its problem.

        Times are shared out equally over the problems that were worked on together, and hold no
        compilation. Those of a plan end with its path; its motion has one of its own.

        Where `plan` would refuse a problem, its plan is not `valid` and `reason` is the sentence;
        others are planned all the same.

        Args:
            problems: `[P, ...]`.
            seed: of roadmaps and trees; the same for each problem.
            trajectory: see `plan`.

        Raises:
            InputError: arrays that are no problems; limits of a motion, as in `plan`.
        """
        motion, seed = motion_options(self.robot, trajectory), check_seed(seed)
        compile_certificates(self.robot)
        search = functools.partial(self.plan_accepted, seed, motion)
        return plan_valid(self.robot, problems, self.options.margin, search)

    @on_host()
    def plan_accepted(
        self, seed: int, motion: MotionOptions | None, problems: Problem
    ) -> list[Plan]:
        """`plan_batch` for P problems that `check_queries` accepts, without asking it."""
        margin = self.options.margin
        compile_certificates(self.robot)
        thick = problems._replace(scene=inflated(problems.scene, margin))
        plans = self._plan_batch(thick, seed, Limits(self.options.time_limit))
        return with_motions(self.robot, plans, problems.scene, motion, margin)

    @on_host()
    def clearance(self, scene: Scene, plan: Plan) -> float:
        """The distance [m] from obstacles that is proven along the whole of a plan's path, up to
        0.25 m, to a millimetre; see `proven_clearance`. It takes ten certificates of the path.

        Raises:
            InputError: the plan has no path.
        """
        if not plan.success:
            raise InputError(f"there is no path to measure: {plan.reason}")
        return proven_clearance(self.robot, scene, plan.path)

    @abc.abstractmethod
    def _plan_batch(self, problems: Problem, seed: int, limits: Limits) -> list[Plan]:
        """`plan_batch`, with obstacles that are as large as the margin makes them, within limits
        of each problem."""

    @abc.abstractmethod
    def warm_up(self, scene: Scene, batch_size: int = 1) -> None:
        """Compiles all that planning in scenes like this may need, unless that was done before.

        Planning does it by itself, part by part, when a query first comes to it; its times never
        contain compilation.

        Args:
            scene: whose padded number of obstacles, and whether one is rotated, are what counts.
            batch_size: problems at once.
        """

    def _at_home(self, scene: Scene, num: int) -> Problem:
        """Problems of the shape of those to come."""
        q = np.tile(self.robot.home, (num, 1))
        return Problem(q, q, jax.tree.map(lambda x: np.broadcast_to(x, (num, *x.shape)), scene))


class GuidedPlanner(Planner):
    """Plans with a guide, in a pool that problems enter and leave (`engine.py`)."""

    strategy: Guided

    def _plan_batch(self, problems: Problem, seed: int, limits: Limits) -> list[Plan]:
        shares = shares_of(len(problems.start))
        # One rotated obstacle in the batch, and all are taken for rotated. Made before threads ask
        # for it, each of which would make its own.
        tester = self._tester(is_axis_aligned(problems.scene))

        def plan(share: Share) -> list[Plan]:
            own = jax.tree.map(lambda x: np.asarray(x)[share.numbers], problems)
            num = len(share.numbers)
            return self._run(tester, own, seed, num, limits, len(shares)).run()

        return side_by_side(plan, shares)

    @on_host()
    def warm_up(self, scene: Scene, batch_size: int = 1) -> None:
        _check_size(batch_size)
        tester = self._tester(is_axis_aligned(scene))
        # One after the other, or each would compile the same.
        for share in shares_of(batch_size):
            with share.at_home():
                num = len(share.numbers)
                self._run(tester, self._at_home(scene, num), 0, num, Limits()).warm_up()

    def _run(
        self,
        tester: SequenceTester,
        problems: Problem,
        seed: int,
        pool: int,
        limits: Limits,
        shares: int = 1,
    ) -> Run:
        batch = Batch(self.robot, problems, limits, tester, shares)
        return Run(batch, self.strategy, self.options, seed, pool)

    @per_object(functools.cache)
    def _tester(self, axis_aligned: bool) -> SequenceTester:
        options = self.options
        checker = make_checker(
            self.robot, options.checker, axis_aligned=axis_aligned, resolution=options.resolution
        )
        return SequenceTester(self.robot, checker, options.resolution)


class SampledPlanner(Planner):
    """Plans on sampled roadmaps, one problem after the other (`sampled_search.py`)."""

    strategy: Strategy

    def _plan_batch(self, problems: Problem, seed: int, limits: Limits) -> list[Plan]:
        return self._search_of(problems, seed, limits).run()

    @on_host()
    def warm_up(self, scene: Scene, batch_size: int = 1) -> None:
        _check_size(batch_size)
        self._search_of(self._at_home(scene, batch_size), 0, Limits()).warm_up()

    def _search_of(self, problems: Problem, seed: int, limits: Limits) -> SampledSearch:
        compiled = self._compiled(is_axis_aligned(problems.scene))
        return SampledSearch(
            self.robot, self.strategy, self.options, limits, compiled, problems, seed
        )

    @per_object(functools.cache)
    def _compiled(self, axis_aligned: bool) -> CompiledStrategy:
        return compile_strategy(self.robot, self.strategy, self.options, axis_aligned)


def _check_size(batch_size: int) -> None:
    if batch_size < 1:
        raise InputError(f"batch_size is {batch_size}; it must be at least 1")
