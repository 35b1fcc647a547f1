"""Sampling-based planners of OMPL, the Open Motion Planning Library, as baselines.

They see the same robot, joint limits and validity as our own planners, stop at the first path, and
are counted the same way: a `Ledger` stands between OMPL and the collision checks. On request, OMPL
simplifies that path. It is an optional extra, imported when the first planner is made; docs/ompl.md
has its parameters and limits.
"""

import functools
import importlib.metadata
import itertools
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.baselines.ledger import Ledger, fused_checks, mujoco_checks
from gnnjax.collision.certify import certify_path
from gnnjax.errors import InputError
from gnnjax.per_object import per_object
from gnnjax.planning.options import PlannerOptions, check_options
from gnnjax.planning.query import Plan, plan_valid
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import Scene, inflated, is_axis_aligned

_CLASSES = {
    "ompl:rrt_connect": "RRTConnect",
    "ompl:rrt_star": "RRTstar",
    "ompl:bit_star": "BITstar",
    "ompl:prm": "PRM",
    "ompl:lazy_prm": "LazyPRM",
    "ompl:ait_star": "AITstar",
    "ompl:eit_star": "EITstar",
}
# EIT* tests points of its edges as configurations and never asks about a motion.
_WITHOUT_EDGES = ("ompl:eit_star",)
# Simplifying stops so long before the time limit, so that a path that was found is not late.
_CLOSING_S = 0.02


class ClassicalPlanner:
    """A planner of OMPL: a `QueryPlanner`, like ours."""

    radius = None  # there is no roadmap of ours

    def __init__(self, robot: Robot, options: PlannerOptions):
        """Args:
        robot: the arm.
        options: planner: which there are depends on the OMPL installed; checker: "fused" (an edge
            is one call of a compiled kernel) or "mujoco" (each configuration is one call of
            MuJoCo's C engine); time_limit: seconds after which a query is given up; simplify:
            whether OMPL's path simplifier goes over the path, in what is left of the time.
        """
        check_options(options)
        self._ompl = _import_ompl()
        if not hasattr(self._ompl.geometric, _CLASSES[options.planner]):
            raise InputError(
                f"OMPL {importlib.metadata.version('ompl')} has no planner {options.planner!r}; "
                "OMPL 1.7.0 has it, in a virtual environment of its own (docs/ompl.md)"
            )
        self.robot, self.options = robot, options

    def warm_up(self, scene: Scene, batch_size: int = 1) -> None:
        """Compiles the checks; problems are planned one after the other, whatever `batch_size`."""
        self._checks_maker(is_axis_aligned(scene), scene.mask.shape[-1])

    def plan_batch(self, problems: Problem, *, seed: int = 0) -> list[Plan]:
        """Plans P problems one after the other.

        The planning time is that of OMPL's `solve` and of simplifying; the total adds setting up.
        Whether the path holds between the configurations tested is found out afterwards, for the
        record and in nobody's time: a path can be a success and not `certified`.

        Args:
            problems: `[P, ...]`.
            seed: of OMPL's random numbers; the same for each problem.

        Raises:
            InputError: arrays that are no problems.
        """
        search = functools.partial(self._plan_accepted, seed)
        return plan_valid(self.robot, problems, self.options.margin, search)

    def _plan_accepted(self, seed: int, problems: Problem) -> list[Plan]:
        problems = problems._replace(scene=inflated(problems.scene, self.options.margin))
        boxes = problems.scene.mask.shape[-1]
        make = self._checks_maker(is_axis_aligned(problems.scene), boxes)
        each = (jax.tree.map(lambda x, i=i: x[i], problems) for i in range(len(problems.start)))
        return [self._plan(problem, make, seed) for problem in each]

    def _plan(self, problem: Problem, make: Callable, seed: int) -> Plan:
        begin = time.perf_counter()
        ledger = Ledger()
        is_valid, test_edge = make(problem.scene, ledger)
        # `plan_valid` has made sure of both, by a test that tells more than the kernels' does.
        for q in (problem.start, problem.goal):
            ledger.know(np.asarray(q, np.float32), lambda _: True)
        ledger.sampling_checks = 2
        setting = _set_up(self, ledger, is_valid, test_edge, problem, seed)
        base, definition = self._ompl.base, setting.definition
        solving = time.perf_counter()
        limit = self.options.time_limit - (solving - begin)
        setting.planner.solve(
            base.plannerOrTerminationCondition(
                base.timedPlannerTerminationCondition(max(limit, 0.0)),
                base.exactSolnPlannerTerminationCondition(definition),
            )
        )
        end = time.perf_counter()
        success = definition.hasExactSolution()
        path = np.zeros((0, self.robot.num_dof), np.float32)
        if success:
            solution = definition.getSolutionPath()
            path = np.stack([setting.read(state) for state in _states(solution)])
            if self.options.simplify:
                ledger.deadline = begin + self.options.time_limit - _CLOSING_S
                path = self._simplified(setting, ledger, solution, path)
                end = time.perf_counter()
        asked = self.options.planner not in _WITHOUT_EDGES
        return Plan(
            success=success,
            reason="" if success else f"no path within {self.options.time_limit} s",
            path=path,
            cost=float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) if success else np.inf,
            certified=success and certify_path(self.robot, problem.scene, path),
            edge_checks=ledger.edge_checks if asked else None,
            configuration_checks=ledger.sampling_checks + ledger.search_checks,
            sampling_checks=ledger.sampling_checks,
            search_checks=ledger.search_checks,
            planning_time_s=end - solving,
            total_time_s=end - begin,
            roadmaps=1,
        )

    def _simplified(
        self, setting: "_Setting", ledger: Ledger, solution: Any, path: np.ndarray
    ) -> np.ndarray:
        """What OMPL's `SimpleSetup.simplifySolution` makes of a path.

        OMPL moves the ends of edges along them and does not test what is left of an edge again, so
        here every edge is asked for once more; most are known.

        Args:
            setting: of the query.
            ledger: of the query, with a deadline.
            solution: OMPL's path; changed in place.
            path: its configurations; the answer where an edge of the simplified path does not hold
                at our resolution, or the time did not suffice.
        """
        definition = setting.definition
        simplifier = self._ompl.geometric.PathSimplifier(
            setting.information, definition.getGoal(), definition.getOptimizationObjective()
        )
        left = ledger.deadline - time.perf_counter()
        if left <= 0:
            return path
        # False: not even the first round goes on after the limit.
        simplifier.simplify(solution, left, False)
        states = _states(solution)
        simplified = np.stack([setting.read(state) for state in states])
        if ledger.cut_off or np.array_equal(simplified, path):
            return path
        holds = all(itertools.starmap(setting.join, itertools.pairwise(states)))
        return simplified if holds and not ledger.cut_off else path

    @per_object(functools.cache)
    def _checks_maker(self, axis_aligned: bool, max_obstacles: int) -> Callable:
        """`(scene, ledger) -> (is_valid, test_edge)`, compiled for one padding of the scene."""
        if self.options.checker == "mujoco":
            return mujoco_checks(self.robot, max_obstacles)
        return fused_checks(self.robot, axis_aligned, max_obstacles, self.options.resolution)


class _Setting(NamedTuple):
    """What OMPL needs for one query; OMPL keeps no references of its own to the validators."""

    planner: Any
    definition: Any
    information: Any
    read: Callable[[Any], np.ndarray]  # the float32 configuration of a state
    join: Callable[[Any, Any], bool]  # whether the edge between two states is valid
    kept: tuple[Any, ...]


def _set_up(
    owner: ClassicalPlanner,
    ledger: Ledger,
    is_valid: Callable[[np.ndarray], bool],
    test_edge: Callable[[np.ndarray, np.ndarray], bool] | None,
    problem: Problem,
    seed: int,
) -> _Setting:
    """A planner of OMPL for one query, with default parameters.

    Args:
        owner: robot, method and resolution.
        ledger: what is known of the query.
        is_valid: tests a configuration.
        test_edge: tests end and interior of an edge; None for OMPL's own way.
        problem: one problem.
        seed: of OMPL's random numbers.
    """
    (base, geometric, util), robot, dof = owner._ompl, owner.robot, owner.robot.num_dof
    # Generators that are made from now on follow from this seed; all of a query's are. OMPL
    # complains, at the level of errors, since those it made before would not.
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed % (2**32 - 1) + 1)  # 0 stands for the time of day
    util.setLogLevel(util.LOG_ERROR)

    space, bounds = base.RealVectorStateSpace(dof), base.RealVectorBounds(dof)
    for i in range(dof):
        bounds.setLow(i, float(robot.joint_lower[i]))
        bounds.setHigh(i, float(robot.joint_upper[i]))
    space.setBounds(bounds)
    space.setLongestValidSegmentFraction(owner.options.resolution / space.getMaximumExtent())
    information = base.SpaceInformation(space)
    joints = range(dof)

    # Single precision, as the kernels take and the path has: what is tested is what is returned.
    def read(state: Any) -> np.ndarray:
        return np.array([state[i] for i in joints], np.float32)

    class ValidityChecker(base.StateValidityChecker):
        def isValid(self, state):
            return ledger.know(read(state), is_valid)

    class MotionValidator(base.MotionValidator):
        # The third argument, in OMPL 1 only, asks for the last valid point; left alone, it says
        # that there is none.
        def checkMotion(self, first, second, last_valid=None):
            start, end = read(first), read(second)
            test = functools.partial(discrete.checkMotion, first, second)
            if test_edge is not None:
                test = functools.partial(test_edge, start, end)
            return ledger.know_edge(start, end, test)

    validity = ValidityChecker(information)
    information.setStateValidityChecker(validity)
    if hasattr(base, "DiscreteMotionValidator"):
        discrete = base.DiscreteMotionValidator(information)
    else:
        information.setup()
        discrete = information.getMotionValidator()
    motions = MotionValidator(information)
    information.setMotionValidator(motions)
    information.setup()

    definition = base.ProblemDefinition(information)
    ends = []
    for q in (problem.start, problem.goal):
        # OMPL 1 makes states of a space, OMPL 2 of its information.
        two = hasattr(base, "RealVectorStateType")
        state = information.allocState() if two else base.State(space)
        for i in joints:
            state[i] = float(q[i])
        ends.append(state)
    definition.setStartAndGoalStates(*ends)
    # Any cost will do: the first path ends the search.
    objective = base.PathLengthOptimizationObjective(information)
    objective.setCostThreshold(objective.infiniteCost())
    definition.setOptimizationObjective(objective)
    planner = getattr(geometric, _CLASSES[owner.options.planner])(information)
    planner.setProblemDefinition(definition)
    planner.setup()
    kept = (space, validity, discrete, motions, objective, *ends)
    return _Setting(planner, definition, information, read, motions.checkMotion, kept)


def _states(path: Any) -> list[Any]:
    return [path.getState(i) for i in range(path.getStateCount())]


class _Ompl(NamedTuple):
    """OMPL's modules."""

    base: ModuleType
    geometric: ModuleType
    util: ModuleType


def _import_ompl() -> _Ompl:
    try:
        from ompl import base, geometric, util  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            "OMPL is not installed; pip install 'gnnjax[experiments]' brings it"
        ) from None
    return _Ompl(base, geometric, util)
