"""The default planner: roadmaps nobody has checked, and a network that says where to look."""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.checker import EDGE_RESOLUTION, EdgeChecks, make_checker
from gnnjax.devices import cache_compilations, over_problems
from gnnjax.errors import InputError, check_seed
from gnnjax.guide.motion import MotionNetwork, Prices, make_prices
from gnnjax.guide.view import arm_view
from gnnjax.planning.query import (
    Plan,
    check_limits,
    check_planner,
    check_query,
    make_plan,
    path_length,
)
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import Roadmap, SampledRoadmap, default_radius, sample_roadmap
from gnnjax.roadmap.stored import NUM_LOCAL, add_local_nodes, insert_ends, stored_roadmap
from gnnjax.scene.scene import Scene, is_axis_aligned
from gnnjax.search.guided import (
    CheckEdge,
    CheckNodes,
    Found,
    Knowledge,
    nothing_known,
    search_guided,
    shorten_guided,
)
from gnnjax.search.lazy import GOAL, INVALID
from gnnjax.search.shorten import NUM_POINTS

# nats; a roadmap whose best path is less likely to be free than e^-this waits until all others
# were tried.
GIVE_UP = 4.0

# Nodes of the roadmaps after the first, beside those around the ends, at least and at most: what a
# small one does not solve is hard, and a large one takes long.
_WIDE_NODES = (400, 600)

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
        num_nodes: nodes of the first roadmap, start and goal included; the others have as
            many, 400 to 600, and 64 more around either end.
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
        self.wide_nodes = int(np.clip(num_nodes, *_WIDE_NODES))
        # Apart, so that weights are arguments of the compiled functions and not constants in them.
        self._graphdef, weights = nnx.split(network)
        self.use_weights(weights)

    def use_weights(self, weights: Any) -> None:
        """Goes on with other weights of the same network; nothing is compiled again."""
        # Restored weights are bound to a device. So would be all that is computed with them, and
        # JAX would compile anew for what is bound and what is not.
        self._weights = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), weights)

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
        kept: list[_Attempt] = []
        for number in range(self.max_roadmaps):
            if not batch.going_on().any():
                break
            kept.append(batch.begin(number))
            batch.work(kept[-1], GIVE_UP)
        # No roadmap had a likely path: now the unlikely ones, each problem's least unlikely first.
        order = np.argsort([attempt.price for attempt in kept], axis=0, kind="stable")
        for chosen in order:
            for number, attempt in enumerate(kept):
                rows = chosen == number
                if (rows & batch.going_on()).any():
                    batch.work(attempt, np.inf, rows)
        return batch.plans()

    def warm_up(self, problems: Problem) -> None:
        """Compiles all that planning P problems of these shapes may need, and plans nothing.

        Without it, a second set of functions is compiled for the first problem whose first roadmap
        has no likely path.
        """
        batch = _Batch(self, problems, 0)
        nobody = batch.active = np.zeros(len(problems.start), bool)
        for number in range(min(2, self.max_roadmaps)):
            found = batch._search(batch.begin(number), nobody, 1, GIVE_UP)
            if self.shorten:
                batch._shorten_once(found, np.zeros(_path_status(len(nobody)), np.int8), nobody)

    @functools.cache  # noqa: B019 - a planner lives as long as its compiled functions
    def functions(self, axis_aligned: bool, max_boxes: int) -> "_Functions":
        """The jitted parts of a query, for one padding of the scene."""
        checker = make_checker(
            self.robot,
            self.checker,
            axis_aligned=axis_aligned,
            resolution=self.resolution,
        )
        view = arm_view(self.robot, self.network.num_points)
        limits = self.robot.joint_lower, self.robot.joint_upper

        def prices_in(weights: Any, scene: Scene) -> Prices:
            network = nnx.merge(self._graphdef, weights)
            return make_prices(network, functools.partial(view, scene))

        def checks_in(scene: Scene) -> tuple[CheckEdge, CheckNodes]:
            def check_edge(start: jax.Array, end: jax.Array) -> EdgeChecks:
                checks = checker.check_edges(scene, start[None], end[None])
                return EdgeChecks(checks.valid[0], checks.num_checks[0])

            return check_edge, functools.partial(checker.check_configurations, scene)

        def begin(weights, stored, key, problem: Problem) -> SampledRoadmap:
            ends = problem.start, problem.goal
            if not self.sampled:
                return SampledRoadmap(insert_ends(stored, *ends, self.radius), jnp.int32(0))
            return sample_roadmap(
                key,
                checks_in(problem.scene)[1],
                self.robot,
                *ends,
                num_nodes=self.num_nodes,
                radius=self.radius,
            )

        def widen(weights, stored, key, problem: Problem) -> SampledRoadmap:
            price = prices_in(weights, problem.scene).nodes
            ends = problem.start, problem.goal
            radius = default_radius(self.robot, self.wide_nodes)
            roadmap = add_local_nodes(key, stored, *ends, radius, limits, price)
            return SampledRoadmap(roadmap, jnp.int32(0))

        def build(make: Callable) -> Callable:
            @jax.jit
            def built(weights, stored, key, problems: Problem, active: jax.Array):
                def one(problem: Problem) -> tuple[SampledRoadmap, Knowledge]:
                    sampled = make(weights, stored, key, problem)
                    known = nothing_known(sampled.roadmap, nodes_checked=self.sampled)
                    return sampled, known

                return over_problems(one, active, problems)

            return built

        @functools.partial(jax.jit, static_argnames="price_all")
        def search(
            weights, roadmaps, scenes, knowledge, longest, max_price, active, price_all: bool
        ) -> tuple[Found, Knowledge]:
            def one(roadmap: Roadmap, scene: Scene, known: Knowledge):
                return search_guided(
                    roadmap,
                    prices_in(weights, scene),
                    *checks_in(scene),
                    known,
                    longest,
                    max_price,
                    price_all=price_all,
                )

            found, known = over_problems(one, active, roadmaps, scenes, knowledge)
            return found, _update(active, known, knowledge)

        @jax.jit
        def shorten(weights, points, scenes, status, active) -> tuple[Found, jax.Array]:
            def one(points: jax.Array, scene: Scene, status: jax.Array):
                prices = prices_in(weights, scene)
                return shorten_guided(points, prices, *checks_in(scene), status)

            found, known = over_problems(one, active, points, scenes, status)
            return found, _update(active, known, status)

        return _Functions(build(begin), build(widen), search, shorten)


class _Functions(NamedTuple):
    """Compiled functions over P problems; arguments as in `GuidedPlanner.functions`."""

    begin: Callable
    widen: Callable
    search: Callable
    shorten: Callable


def _update(rows: jax.Array, new: Any, old: Any) -> Any:
    """The new values where `rows` `[P]`, and the old ones elsewhere."""
    return jax.tree.map(
        lambda x, y: jnp.where(rows.reshape(-1, *[1] * (x.ndim - 1)), x, y), new, old
    )


def _path_status(num: int) -> tuple[int, int, int]:
    """Shape of what is known of the path roadmaps of P problems."""
    return num, NUM_POINTS, NUM_POINTS


@dataclasses.dataclass(eq=False)
class _Attempt:
    """The roadmaps of one attempt, and what is known of them."""

    roadmaps: Roadmap
    knowledge: Knowledge
    price_all: bool
    price: np.ndarray  # [P] nats, of the cheapest path when it was last searched; inf without one


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

    def going_on(self) -> np.ndarray:
        """Which problems are still open and have time left, `[P]`."""
        return self.active & (self.total_time <= self.planner.time_limit)

    def begin(self, number: int) -> _Attempt:
        """The roadmaps of an attempt."""
        planner, active = self.planner, self.going_on()
        start = time.perf_counter()
        key = jax.random.fold_in(jax.random.key(self.seed), number)
        wide = number > 0 and not planner.sampled
        stored = None
        if not planner.sampled:
            seed = self.seed * _ROADMAPS_A_SEED + number
            num_nodes = planner.wide_nodes if wide else planner.num_nodes
            stored = stored_roadmap(planner.robot, num_nodes - 2, seed)
        make = self.functions.widen if wide else self.functions.begin
        sampled, knowledge = jax.block_until_ready(
            make(planner._weights, stored, key, self.problems, active)
        )
        taken = (time.perf_counter() - start) / max(1, active.sum())
        self.total_time += np.where(active, taken, 0)
        self.sampling_checks += np.where(active, sampled.num_checks, 0)
        self.roadmaps += active
        return _Attempt(sampled.roadmap, knowledge, wide, np.full(len(active), np.inf))

    def work(self, attempt: _Attempt, max_price: float, rows: np.ndarray | bool = True) -> None:
        """Searches roadmaps until paths are certified, or too dear, or there are none."""
        begin, open_ = time.perf_counter(), self.going_on() & rows
        worked_on = open_.copy()
        if self.planner.shorten:
            # Checked are single edges, which cannot be shortened. Longer paths are shortened first.
            found = self._search(attempt, open_, 1, max_price)
            likely = open_ & np.asarray(found.success) & (np.asarray(found.price) <= max_price)
            single = np.asarray(found.path)[:, 1] == GOAL
            self._certify(attempt, found, likely & single)
            self._shorten(found, likely & ~single)
            # What had no likely path has none when it is searched again.
            open_ &= self.active & likely
        while open_.any():
            found = self._search(attempt, open_, attempt.roadmaps.nodes.shape[1], max_price)
            open_ &= np.asarray(found.success)
            certified = self._certify(attempt, found, open_)
            if self.planner.shorten:
                self._shorten(found, certified & (np.asarray(found.path)[:, 1] != GOAL))
            open_ &= ~certified
        taken = (time.perf_counter() - begin) / max(1, worked_on.sum())
        self.planning_time += np.where(worked_on, taken, 0)
        self.total_time += np.where(worked_on, taken, 0)

    def _search(
        self, attempt: _Attempt, rows: np.ndarray, longest_checked: int, max_price: float
    ) -> Found:
        found, attempt.knowledge = jax.block_until_ready(
            self.functions.search(
                self.planner._weights,
                attempt.roadmaps,
                self.problems.scene,
                attempt.knowledge,
                np.int32(longest_checked),
                np.float32(max_price),
                rows,
                price_all=attempt.price_all,
            )
        )
        self._count(found, rows)
        attempt.price = np.where(rows, found.price, attempt.price)
        return found

    def _shorten(self, found: Found, rows: np.ndarray) -> None:
        """Shortens the paths of some problems, and keeps what is certified and shorter."""
        status = np.zeros(_path_status(len(rows)), np.int8)
        rows = rows.copy()
        while rows.any():
            short, known = self._shorten_once(found, status, rows)
            rows &= np.asarray(short.success)
            status = np.array(known)
            for i in np.flatnonzero(rows):
                walked, certified = self._keep_if_certified(int(i), short)
                rows[i] = not certified.all()
                for step in np.flatnonzero(~certified):
                    ends = walked[[step, step + 1]]
                    status[i, ends, ends[::-1]] = INVALID

    def _shorten_once(
        self, found: Found, status: np.ndarray, rows: np.ndarray
    ) -> tuple[Found, jax.Array]:
        short, known = jax.block_until_ready(
            self.functions.shorten(
                self.planner._weights, found.points, self.problems.scene, status, rows
            )
        )
        self._count(short, rows)
        return short, known

    def _certify(self, attempt: _Attempt, found: Found, rows: np.ndarray) -> np.ndarray:
        """Keeps the certified paths of some problems, and notes which edges are not.

        Returns:
            `[P]`, true where a path was kept.
        """
        kept = np.zeros(len(rows), bool)
        for i in np.flatnonzero(rows):
            walked, certified = self._keep_if_certified(int(i), found)
            kept[i] = certified.all()
            if kept[i]:
                continue
            status = np.array(attempt.knowledge.status)
            for step in np.flatnonzero(~certified):
                for near, far in (walked[[step, step + 1]], walked[[step + 1, step]]):
                    slots = np.asarray(attempt.roadmaps.neighbors)[i, near] == far
                    status[i, near, slots] = INVALID
            attempt.knowledge = attempt.knowledge._replace(status=status)
        return kept

    def _keep_if_certified(self, i: int, found: Found) -> tuple[np.ndarray, np.ndarray]:
        """Keeps the path of problem i if it is certified, and shorter than what there is.

        Returns:
            The nodes of the path, and which of its edges are certified.
        """
        walked = np.asarray(found.path)[i]
        walked = walked[walked >= 0]
        path = np.asarray(found.waypoints)[i][: len(walked)]
        scene = jax.tree.map(lambda x: x[i], self.scenes)
        certified = certify_edges(self.planner.robot, scene, path[:-1], path[1:])
        known = self.paths[i]
        if certified.all() and (known is None or path_length(path) < path_length(known)):
            self.paths[i] = path
            self.active[i] = False
        return walked, certified

    def _count(self, found: Found, rows: np.ndarray) -> None:
        self.edge_checks += np.where(rows, found.edge_checks, 0)
        self.search_checks += np.where(rows, found.configuration_checks, 0)

    def plans(self) -> list[Plan]:
        """What came out."""
        return [
            make_plan(
                path,
                f"no path in the {self.roadmaps[i]} roadmaps tried ({self.planner.num_nodes} "
                f"nodes, then {self.planner.wide_nodes} and {2 * NUM_LOCAL} around the ends)",
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
