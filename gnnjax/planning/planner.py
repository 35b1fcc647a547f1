"""Plans queries: sample a roadmap, search it, certify the path."""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.checker import EDGE_RESOLUTION, EdgeChecks, make_checker
from gnnjax.devices import cache_compilations, over_problems
from gnnjax.errors import InputError, check_seed
from gnnjax.guide.motion import MotionNetwork
from gnnjax.guide.view import point_distances
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.paper.validity import edge_price
from gnnjax.planning.guided import GuidedPlanner
from gnnjax.planning.query import Plan, check_limits, check_planner, check_query, make_plan
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import (
    Roadmap,
    SampledRoadmap,
    default_radius,
    edge_bucket,
    sample_roadmap,
)
from gnnjax.roadmap.paths import cost_to_go, edge_validity, next_slots
from gnnjax.scene.scene import Scene, is_axis_aligned
from gnnjax.search.lazy import (
    INVALID,
    VALID,
    SearchResult,
    distance_scorer,
    follow,
    greedy_search,
    lazy_search,
    network_scorer,
    oracle_scorer,
)
from gnnjax.training.checkpoint import default_weights, load_network

Method = Literal["guided", "gnn", "gnn_lazy", "distance", "oracle", "prm", "lazysp"]
NETWORK_METHODS = ("guided", "gnn", "gnn_lazy")

DEFAULT_MAX_ROADMAPS = 8


def load_planner(
    robot: str | Path,
    method: str = "guided",
    *,
    num_nodes: int = 200,
    max_roadmaps: int = DEFAULT_MAX_ROADMAPS,
    weights: str | Path | None = None,
    shorten: bool = True,
    sampled: bool = False,
    checker: str = "fused",
    resolution: float = EDGE_RESOLUTION,
    time_limit: float = np.inf,
) -> "Planner | GuidedPlanner":
    """Loads a robot, and weights where they are needed, and makes a planner.

    Args:
        robot: name of a shipped robot, or path of an MJCF.
        method: "guided" (lazy search for the path that is cheapest by length and the motion
            network's doubts, shortened before it is checked); "gnn" (the paper's greedy search by
            the guidance network's values), "gnn_lazy" (lazy search with that network), "distance"
            (greedy by the distance to the goal), "lazysp" (lazy shortest path), "prm" (all edges
            checked) or "oracle" (greedy by the exact cost-to-go: a bound, not a planner).
        num_nodes: nodes of a roadmap, start and goal included.
        max_roadmaps: on failure, take a new roadmap up to this many times; 1 is the paper's way.
        weights: checkpoint folder of the network, or the name of shipped weights; by default those
            of the method, and for the guidance network of the robot or the Kuka.
        shorten: see `GuidedPlanner`, like `sampled`.
        sampled: for "guided" alone; the other planners' roadmaps always are.
        checker: collision backend, "fused" or "mjx".
        resolution: largest distance of neighbouring configurations tested along an edge, rad or m.
        time_limit: after this many seconds no further roadmap is begun.
    """
    check_guided_options(method, shorten=shorten, sampled=sampled)
    loaded = load_robot(robot)
    options: dict[str, Any] = {
        "checker": checker,
        "resolution": resolution,
        "time_limit": time_limit,
    }
    network = None
    if method in NETWORK_METHODS:
        network = load_network(default_weights(loaded.name, method) if weights is None else weights)
        wanted = MotionNetwork if method == "guided" else GuidanceNetwork
        if not isinstance(network, wanted):
            raise InputError(
                f"planner {method!r} takes a {wanted.__name__}, and {str(weights)!r} is a "
                f"{type(network).__name__}; name other weights"
            )
    if isinstance(network, MotionNetwork):
        return GuidedPlanner(
            loaded, network, num_nodes, max_roadmaps, shorten=shorten, sampled=sampled, **options
        )
    return Planner(loaded, method, num_nodes, max_roadmaps, network=network, **options)


def check_guided_options(method: str, *, shorten: bool, sampled: bool) -> None:
    """Refuses the options of "guided" with other planners, where they are not at their defaults."""
    if method != "guided" and (sampled or not shorten):
        option = "sampled" if sampled else "shorten=False"
        raise InputError(
            f"{option} with planner {method!r}; it is for planner 'guided', leave it out"
        )


class Planner:
    """Plans queries for one robot on roadmaps of checked nodes.

    Compiles on the first query and keeps the result on disk.
    """

    def __init__(
        self,
        robot: Robot,
        method: str = "lazysp",
        num_nodes: int = 200,
        max_roadmaps: int = DEFAULT_MAX_ROADMAPS,
        *,
        network: GuidanceNetwork | None = None,
        checker: str = "fused",
        resolution: float = EDGE_RESOLUTION,
        time_limit: float = np.inf,
    ):
        if method not in get_args(Method) or method == "guided":
            raise InputError(f"no planner {method!r}; there are {list(get_args(Method))}")
        check_planner(checker, num_nodes, max_roadmaps)
        check_limits(resolution, time_limit)
        if (method in NETWORK_METHODS) != (network is not None):
            raise InputError(
                f"planner {method!r} with network {network}; 'gnn' and 'gnn_lazy' take one, "
                "and only they"
            )
        if method == "gnn_lazy" and network is not None and not network.validity_head:
            raise InputError(
                "planner 'gnn_lazy' needs a network that was trained with validity_weight > 0"
            )
        if network is not None and robot.num_dof > network.num_dof:
            raise InputError(
                f"the network is made for up to {network.num_dof} joints, {robot.name} has "
                f"{robot.num_dof}; train one with --num-dof {robot.num_dof}"
            )
        cache_compilations()
        self.robot, self.method, self.checker = robot, method, checker
        self.num_nodes, self.max_roadmaps = num_nodes, max_roadmaps
        self.resolution, self.time_limit = resolution, time_limit
        self.radius = default_radius(robot, num_nodes)
        # Apart, so that weights are arguments of the compiled functions and not constants in them.
        self.network = network
        self._graphdef, self._weights = (None, None) if network is None else nnx.split(network)

    def use_weights(self, weights: Any) -> None:
        """Goes on with other weights of the same network; nothing is compiled again."""
        self._weights = weights

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
        num, seed = len(problems.start), check_seed(seed)
        build, search_weighted = self._functions(
            is_axis_aligned(problems.scene), problems.scene.mask.shape[-1]
        )
        paths: list[np.ndarray | None] = [None] * num
        # Start and goal were tested too.
        sampling_checks = np.full(num, 2)
        edge_checks, search_checks, roadmaps = np.zeros((3, num), int)
        planning_time, total_time = np.zeros((2, num))
        active = np.ones(num, bool)
        for attempt in range(self.max_roadmaps):
            share = 1 / active.sum()
            begin = time.perf_counter()
            built = jax.block_until_ready(build(seed, attempt, problems, active))
            searched = time.perf_counter()
            search = functools.partial(search_weighted, self._weights)
            found, walks = self._search_certified(search, built.roadmap, problems.scene, active)
            end = time.perf_counter()
            planning_time += np.where(active, (end - searched) * share, 0)
            total_time += np.where(active, (end - begin) * share, 0)
            sampling_checks += np.where(active, built.num_checks, 0)
            edge_checks += found.edge_checks
            search_checks += found.configuration_checks
            roadmaps += active
            for i, walk in walks.items():
                paths[i] = walk
                active[i] = False
            active &= total_time <= self.time_limit
            if not active.any():
                break
        return [
            make_plan(
                path,
                f"no path in the {roadmaps[i]} roadmaps tried ({self.num_nodes} nodes, "
                f"radius {self.radius:.2f})",
                self.robot.num_dof,
                edge_checks=int(edge_checks[i]),
                sampling_checks=int(sampling_checks[i]),
                search_checks=int(search_checks[i]),
                planning_time_s=float(planning_time[i]),
                total_time_s=float(total_time[i]),
                roadmaps=int(roadmaps[i]),
            )
            for i, path in enumerate(paths)
        ]

    def check_query(
        self, scene: Scene, start: ArrayLike, goal: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns start and goal as arrays, or says what is wrong with the query."""
        return check_query(self.robot, scene, start, goal)

    def _search_certified(
        self, search: Callable, roadmaps: Roadmap, scenes: Scene, active: np.ndarray
    ) -> tuple[SearchResult, dict[int, np.ndarray]]:
        """Searches until a path is certified or there is none; refuted edges are searched around.

        Edges already known cost nothing when the search is run again.

        Returns:
            The last search of each problem with the checks of all of them, and the certified paths.
        """
        status = np.zeros(roadmaps.neighbors.shape, np.int8)  # nothing is known
        on_host, scenes_on_host = jax.tree.map(np.asarray, (roadmaps, scenes))
        paths: dict[int, np.ndarray] = {}
        edge_checks, configuration_checks = np.zeros((2, len(active)), int)
        open_ = active.copy()
        while True:
            found = jax.block_until_ready(search(roadmaps, scenes, status, open_))
            status = np.array(found.edge_status)
            edge_checks += np.where(open_, found.edge_checks, 0)
            configuration_checks += np.where(open_, found.configuration_checks, 0)
            open_ &= np.asarray(found.success)
            path = np.asarray(found.path)
            for i in np.flatnonzero(open_):
                walked = path[i][path[i] >= 0]
                nodes = on_host.nodes[i, walked]
                scene = jax.tree.map(lambda x, i=i: x[i], scenes_on_host)
                certified = certify_edges(self.robot, scene, nodes[:-1], nodes[1:])
                if certified.all():
                    paths[int(i)] = nodes
                    open_[i] = False
                for step in np.flatnonzero(~certified):
                    for near, far in (walked[[step, step + 1]], walked[[step + 1, step]]):
                        status[i, near, on_host.neighbors[i, near] == far] = INVALID
            if not open_.any():
                checks = {"edge_checks": edge_checks, "configuration_checks": configuration_checks}
                return found._replace(**checks), paths

    @functools.cache  # noqa: B019 - a planner lives as long as its compiled functions
    def _functions(self, axis_aligned: bool, max_boxes: int):
        """The jitted halves of a query, for one padding of the scene."""
        checker = make_checker(
            self.robot,
            self.checker,
            axis_aligned=axis_aligned,
            resolution=self.resolution,
        )

        points = 0 if self.network is None else self.network.workspace_points
        distances = point_distances(self.robot, points) if points else None

        def build_one(key: jax.Array, problem: Problem) -> SampledRoadmap:
            check = functools.partial(checker.check_configurations, problem.scene)
            return sample_roadmap(
                key,
                check,
                self.robot,
                problem.start,
                problem.goal,
                num_nodes=self.num_nodes,
                radius=self.radius,
            )

        def search_one(weights, roadmap: Roadmap, scene: Scene, status: jax.Array) -> SearchResult:
            network = None if self._graphdef is None else nnx.merge(self._graphdef, weights)
            check = functools.partial(checker.check_edges, scene)
            return search_roadmap(self.method, roadmap, scene, check, network, distances, status)

        @jax.jit
        def build(seed, attempt, problems: Problem, active: jax.Array) -> SampledRoadmap:
            key = jax.random.fold_in(jax.random.key(seed), attempt)
            return over_problems(functools.partial(build_one, key), active, problems)

        @jax.jit
        def search(weights, roadmaps, scenes, status, active: jax.Array) -> SearchResult:
            one = functools.partial(search_one, weights)
            return over_problems(one, active, roadmaps, scenes, status)

        return build, search


def search_roadmap(
    method: Method,
    roadmap: Roadmap,
    scene: Scene,
    check_edges: Callable[[jax.Array, jax.Array], EdgeChecks],
    network: GuidanceNetwork | None,
    point_distances: Callable[[Scene, jax.Array], jax.Array] | None,
    status: jax.Array,
) -> SearchResult:
    """Searches one roadmap by a named method.

    Args:
        method: see `load_planner`.
        roadmap: one roadmap.
        scene: what the network sees of the obstacles.
        check_edges: `(starts [E D], ends [E D]) -> EdgeChecks [E]`.
        network: for the methods "gnn" and "gnn_lazy".
        point_distances: of the arm, if the network reads them.
        status: what is known of its edges.
    """

    def check_edge(start: Float[Array, " D"], end: Float[Array, " D"]) -> EdgeChecks:
        checks = check_edges(start[None], end[None])
        return EdgeChecks(checks.valid[0], checks.num_checks[0])

    if network is not None:
        max_edges = edge_bucket(len(roadmap.nodes))
        encoding = network.encode(roadmap, scene, max_edges, point_distances)
        if method == "gnn_lazy":
            return lazy_search(roadmap, check_edge, status, edge_price(encoding.validity))
        scorer = network_scorer(network, encoding, roadmap)
        return greedy_search(roadmap, scorer, check_edge, status)
    if method == "distance":
        return greedy_search(roadmap, distance_scorer(roadmap), check_edge, status)
    if method == "lazysp":
        return lazy_search(roadmap, check_edge, status)
    labelled = edge_validity(roadmap, check_edges)
    usable = labelled.edge_valid & (status != INVALID)
    edge_cost = jnp.where(usable, roadmap.lengths, jnp.inf)
    cost = cost_to_go(roadmap, edge_cost)
    if method == "oracle":
        return greedy_search(roadmap, oracle_scorer(roadmap, cost), check_edge, status)
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
