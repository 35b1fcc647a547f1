"""The default planner: roadmaps nobody has checked, and a network that says where to look."""

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import ArrayLike

from gnnjax.certify import certify_edges
from gnnjax.collision import EDGE_RESOLUTION, EdgeChecks, make_checker
from gnnjax.compilation import cache_compilations, over_problems
from gnnjax.errors import InputError, check_seed
from gnnjax.guided import Guided, Knowledge, guided_search, nothing_known
from gnnjax.motion import MotionNetwork, make_prices
from gnnjax.problem import Problem
from gnnjax.query import Plan, check_limits, check_planner, check_query, make_plan
from gnnjax.roadmap import Roadmap, default_radius, sample_roadmap
from gnnjax.robot import Robot
from gnnjax.scene import Scene, is_axis_aligned
from gnnjax.search import INVALID
from gnnjax.shorten import NUM_POINTS
from gnnjax.stored import add_local_nodes, insert_ends, stored_roadmap
from gnnjax.workspace import arm_view

# nats; a roadmap whose best path is less likely to be free than e^-this waits until all others
# were tried.
GIVE_UP = 4.0

_ROADMAPS_A_SEED = 1000  # seeds of stored roadmaps: of query seed s, from 1000 s on


class GuidedPlanner:
    """Plans queries for one robot with a motion network.

    Roadmap after roadmap is searched for a path that is likely free; only when none of them has
    one are they searched to the end, one after the other. So a path is found wherever one of the
    roadmaps has one. Compiles on the first query and keeps the result on disk.
    """

    method = "guided"

    def __init__(
        self,
        robot: Robot,
        network: MotionNetwork,
        num_nodes: int = 200,
        max_roadmaps: int = 8,
        *,
        shorten: bool = True,
        sampled: bool = False,
        checker: str = "fused",
        resolution: float = EDGE_RESOLUTION,
        time_limit: float = np.inf,
    ):
        """Args:
        robot: the arm.
        network: what tells free motions from blocked ones.
        num_nodes: nodes of a roadmap, start and goal included.
        max_roadmaps: roadmaps to try.
        shorten: shorten paths before they are checked.
        sampled: search roadmaps whose nodes are drawn and tested for each query, like those of
            the other planners, to compare searches.
        checker: "fused" or "mjx".
        resolution: largest distance of neighbouring configurations tested along an edge.
        time_limit: after this many seconds no further roadmap is begun.
        """
        check_planner(checker, num_nodes, max_roadmaps)
        if num_nodes < NUM_POINTS:
            raise InputError(
                f"num_nodes is {num_nodes}; planner 'guided' needs at least {NUM_POINTS}"
            )
        check_limits(resolution, time_limit)
        cache_compilations()
        self.robot, self.network, self.checker = robot, network, checker
        self.num_nodes, self.max_roadmaps = num_nodes, max_roadmaps
        self.shorten, self.sampled = shorten, sampled
        self.resolution, self.time_limit = resolution, time_limit
        self.radius = default_radius(robot, num_nodes)
        # Apart, so that weights are arguments of the compiled functions and not constants in them.
        self._graphdef, self._weights = nnx.split(network)

    def use_weights(self, weights: Any) -> None:
        """Goes on with other weights of the same network; nothing is compiled again."""
        self._weights = weights

    def check_query(
        self, scene: Scene, start: ArrayLike, goal: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns start and goal as arrays, or says what is wrong with the query."""
        return check_query(self.robot, scene, start, goal)

    def plan(self, scene: Scene, start: ArrayLike, goal: ArrayLike, *, seed: int = 0) -> Plan:
        """Finds a certified path from start to goal `[D]`.

        Raises:
            InputError: start or goal is no valid configuration, or a box stands in the base.
        """
        begin = time.perf_counter()
        start, goal = self.check_query(scene, start, goal)
        problems = jax.tree.map(lambda x: np.asarray(x)[None], Problem(start, goal, scene))
        plan = self.plan_batch(problems, seed=seed)[0]
        # What checking the query took belongs to it.
        return plan._replace(total_time_s=time.perf_counter() - begin)

    def plan_batch(self, problems: Problem, *, seed: int = 0) -> list[Plan]:
        """Plans P problems at once; every plan is what `plan` finds for its problem.

        Times are shared out equally over the problems that were worked on together.

        Args:
            problems: `[P, ...]`, which `check_query` accepts.
            seed: of the roadmaps; the same for each problem.
        """
        batch = _Batch(self, problems, check_seed(seed))
        kept: list[tuple[Roadmap, Knowledge]] = []
        for attempt in range(self.max_roadmaps):
            if not batch.going_on():
                break
            kept.append(batch.search(*batch.build(attempt), GIVE_UP))
        # No roadmap had a likely path: now the unlikely ones.
        for roadmaps, knowledge in kept:
            if not batch.going_on():
                break
            batch.search(roadmaps, knowledge, np.inf)
        return batch.plans()

    @functools.cache  # noqa: B019 - a planner lives as long as its compiled functions
    def functions(self, axis_aligned: bool, max_boxes: int):
        """The jitted parts of a query, for one padding of the scene: `(begin, widen, search)`."""
        checker = make_checker(
            self.robot,
            self.checker,  # type: ignore[arg-type]
            axis_aligned=axis_aligned,
            max_boxes=max_boxes,
            resolution=self.resolution,
        )
        view = arm_view(self.robot, self.network.num_points)
        limits = self.robot.joint_lower, self.robot.joint_upper

        def prices_in(weights: Any, scene: Scene):
            network = nnx.merge(self._graphdef, weights)
            return make_prices(network, functools.partial(view, scene))

        def known(roadmap: Roadmap) -> Knowledge:
            return nothing_known(*roadmap.neighbors.shape, nodes_checked=self.sampled)

        @jax.jit
        def begin(_, stored: Roadmap, key, problems: Problem, active: jax.Array):
            def one(problem: Problem):
                if not self.sampled:
                    roadmap = insert_ends(stored, problem.start, problem.goal, self.radius)
                    return roadmap, known(roadmap), jnp.int32(0)
                drawn = sample_roadmap(
                    key,
                    functools.partial(checker.check_configurations, problem.scene),
                    self.robot,
                    problem.start,
                    problem.goal,
                    num_nodes=self.num_nodes,
                    radius=self.radius,
                )
                return drawn.roadmap, known(drawn.roadmap), drawn.num_checks

            return over_problems(one, active, problems)

        @jax.jit
        def widen(weights: Any, stored: Roadmap, key, problems: Problem, active: jax.Array):
            def one(problem: Problem):
                roadmap = add_local_nodes(
                    key,
                    stored,
                    problem.start,
                    problem.goal,
                    self.radius,
                    limits,
                    prices_in(weights, problem.scene).nodes,
                )
                return roadmap, known(roadmap), jnp.int32(0)

            return over_problems(one, active, problems)

        @jax.jit
        def search(weights, roadmaps, scenes, knowledge, max_price, active: jax.Array) -> Guided:
            def one(roadmap: Roadmap, scene: Scene, knowledge: Knowledge) -> Guided:
                def check_edge(start: jax.Array, end: jax.Array) -> EdgeChecks:
                    checks = checker.check_edges(scene, start[None], end[None])
                    return EdgeChecks(checks.valid[0], checks.num_checks[0])

                return guided_search(
                    roadmap,
                    prices_in(weights, scene),
                    check_edge,
                    functools.partial(checker.check_configurations, scene),
                    knowledge,
                    max_price,
                    shorten=self.shorten,
                )

            return over_problems(one, active, roadmaps, scenes, knowledge)

        return begin, widen, search


class _Batch:
    """P problems on their way: what was found and what it cost."""

    def __init__(self, planner: GuidedPlanner, problems: Problem, seed: int):
        self.planner, self.problems, self.seed = planner, problems, seed
        num = len(problems.start)
        self.scenes = jax.tree.map(np.asarray, problems.scene)
        aligned = is_axis_aligned(problems.scene)
        self.functions = planner.functions(aligned, problems.scene.mask.shape[-1])
        self.active = np.ones(num, bool)
        self.paths: list[np.ndarray | None] = [None] * num
        self.sampling_checks = np.full(num, 2)  # start and goal
        self.edge_checks, self.search_checks, self.roadmaps = np.zeros((3, num), int)
        self.planning_time, self.total_time = np.zeros((2, num))

    def going_on(self) -> bool:
        """Whether any problem is still open and has time left."""
        return bool((self.active & (self.total_time <= self.planner.time_limit)).any())

    def build(self, attempt: int) -> tuple[Roadmap, Knowledge]:
        """The roadmaps of an attempt."""
        planner = self.planner
        start = time.perf_counter()
        key = jax.random.fold_in(jax.random.key(self.seed), attempt)
        stored = None
        if not planner.sampled:
            number = self.seed * _ROADMAPS_A_SEED + attempt
            stored = stored_roadmap(planner.robot, planner.num_nodes - 2, number)
        begin, widen, _ = self.functions
        make = widen if attempt and not planner.sampled else begin
        roadmaps, knowledge, num_checks = jax.block_until_ready(
            make(planner._weights, stored, key, self.problems, self.active)
        )
        self.total_time += np.where(
            self.active, (time.perf_counter() - start) / self.active.sum(), 0
        )
        self.sampling_checks += np.where(self.active, num_checks, 0)
        self.roadmaps += self.active
        return roadmaps, knowledge

    def search(
        self, roadmaps: Roadmap, knowledge: Knowledge, max_price: float
    ) -> tuple[Roadmap, Knowledge]:
        """Searches until a path is certified or there is none, around edges that are not."""
        begin = time.perf_counter()
        worked_on = self.active & (self.total_time <= self.planner.time_limit)
        open_ = worked_on.copy()
        limit = np.float32(max_price)
        while True:
            found = jax.block_until_ready(
                self.functions[2](
                    self.planner._weights, roadmaps, self.problems.scene, knowledge, limit, open_
                )
            )
            knowledge = jax.tree.map(functools.partial(_update, open_), found.knowledge, knowledge)
            self.edge_checks += np.where(open_, found.edge_checks, 0)
            self.search_checks += np.where(open_, found.configuration_checks, 0)
            open_ &= np.asarray(found.success)
            for i in np.flatnonzero(open_):
                open_[i] = not self._certify(int(i), found, roadmaps, knowledge)
            if not open_.any():
                break
        taken = (time.perf_counter() - begin) / max(1, worked_on.sum())
        self.planning_time += np.where(worked_on, taken, 0)
        self.total_time += np.where(worked_on, taken, 0)
        return roadmaps, knowledge

    def _certify(self, i: int, found: Guided, roadmaps: Roadmap, knowledge: Knowledge) -> bool:
        """Keeps the path of problem i if it is certified; else notes which edges are not."""
        walked = np.asarray(found.path[i])
        walked = walked[walked >= 0]
        waypoints = np.asarray(found.waypoints[i])[: len(walked)]
        scene = jax.tree.map(lambda x: x[i], self.scenes)
        certified = certify_edges(self.planner.robot, scene, waypoints[:-1], waypoints[1:])
        if certified.all():
            self.paths[i] = waypoints
            self.active[i] = False
            return True
        number = int(found.shortened[i])
        for step in np.flatnonzero(~certified):
            for near, far in (walked[[step, step + 1]], walked[[step + 1, step]]):
                if number >= 0:
                    knowledge.shortcuts[i, number, near, far] = INVALID
                else:
                    at_far = np.asarray(roadmaps.neighbors[i, near]) == far
                    knowledge.status[i, near, at_far] = INVALID
        return False

    def plans(self) -> list[Plan]:
        """What came out."""
        return [
            make_plan(
                path,
                f"no path in the {self.roadmaps[i]} roadmaps tried ({self.planner.num_nodes} "
                f"nodes, radius {self.planner.radius:.2f})",
                self.planner.robot.num_dof,
                edge_checks=int(self.edge_checks[i]),
                sampling_checks=int(self.sampling_checks[i]),
                search_checks=int(self.search_checks[i]),
                planning_time_s=float(self.planning_time[i]),
                total_time_s=float(self.total_time[i]),
                roadmaps=int(self.roadmaps[i]),
            )
            for i, path in enumerate(self.paths)
        ]


def _update(rows: np.ndarray, new: jax.Array, old: Any) -> np.ndarray:
    """The new values where `rows` `[P]`, and the old ones elsewhere."""
    return np.where(rows.reshape(-1, *[1] * (new.ndim - 1)), new, old)
