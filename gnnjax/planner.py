"""Plans one query: sample a roadmap, search it, certify the path."""

import functools
import time
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from gnnjax.certify import certify_edges, configuration_clearance
from gnnjax.collision import Backend, EdgeChecks, boxes_clear, make_checker
from gnnjax.errors import InputError
from gnnjax.labels import cost_to_go, edge_validity, next_slots
from gnnjax.roadmap import (
    Roadmap,
    connect,
    default_mean_degree,
    default_slots,
    node_bucket,
    radius_for_degree,
    reverse_slots,
)
from gnnjax.robot import Robot, load_robot
from gnnjax.sampling import sample_free
from gnnjax.scene import Scene, is_axis_aligned
from gnnjax.search import (
    INVALID,
    VALID,
    SearchResult,
    distance_scorer,
    follow,
    greedy_search,
    lazy_search,
    learn_edge,
    oracle_scorer,
    unknown_edges,
)

Method = Literal["distance", "oracle", "prm", "lazysp"]

DEFAULT_MAX_ROADMAPS = 8


class Plan(NamedTuple):
    """The answer to a query."""

    success: bool
    reason: str  # why there is no path; empty on success
    path: np.ndarray  # [L D] configurations from start to goal; [0 D] without success
    cost: float  # length of the path, configuration units; inf without success
    certified: bool  # the path is proven free of collisions all along
    edge_checks: int
    configuration_checks: int  # all of them: sampling and search
    sampling_checks: int  # start, goal and the draws for nodes
    search_checks: int  # along edges
    planning_time_s: float  # from the roadmap to the path
    total_time_s: float  # from the query to the path
    roadmaps: int  # roadmaps sampled


class _Built(NamedTuple):
    """A roadmap and what sampling it took."""

    roadmap: Roadmap
    num_checks: Int[Array, ""]
    num_sampled: Int[Array, ""]


def load_planner(
    robot: str | Path,
    method: Method = "lazysp",
    *,
    num_nodes: int = 200,
    max_roadmaps: int = DEFAULT_MAX_ROADMAPS,
    backend: Backend = "fused",
) -> "Planner":
    """Loads a robot and makes a planner for it.

    Args:
        robot: name of a shipped robot, or path of an MJCF.
        method: "lazysp" (lazy shortest path), "prm" (all edges checked), "distance" (greedy to the
            goal) or "oracle" (greedy by the exact cost-to-go: a bound, not a planner).
        num_nodes: nodes of a roadmap, start and goal included.
        max_roadmaps: on failure, sample a new roadmap up to this many times; 1 is the paper's way.
        backend: collision backend, "fused" or "mjx".
    """
    return Planner(load_robot(robot), method, num_nodes, max_roadmaps, backend)


class Planner:
    """Plans queries for one robot. Compiles on the first query and keeps the result on disk."""

    def __init__(
        self,
        robot: Robot,
        method: Method = "lazysp",
        num_nodes: int = 200,
        max_roadmaps: int = DEFAULT_MAX_ROADMAPS,
        backend: Backend = "fused",
    ):
        if method not in get_args(Method):
            raise InputError(f"no planner {method!r}; there are {list(get_args(Method))}")
        if num_nodes < 2:
            raise InputError(f"num_nodes is {num_nodes}; a roadmap needs at least start and goal")
        if max_roadmaps < 1:
            raise InputError(f"max_roadmaps is {max_roadmaps}; it must be at least 1")
        cache_compilations()
        self.robot, self.method, self.backend = robot, method, backend
        self.num_nodes, self.max_roadmaps = num_nodes, max_roadmaps
        self.radius = radius_for_degree(robot, num_nodes, default_mean_degree(num_nodes))

    def plan(self, scene: Scene, start: ArrayLike, goal: ArrayLike, *, seed: int = 0) -> Plan:
        """Finds a certified path from start to goal `[D]`.

        Raises:
            InputError: start or goal is no valid configuration, or a box stands in the base.
        """
        begin = time.perf_counter()
        scene = jax.tree.map(jnp.asarray, scene)
        start, goal = self._check_query(scene, start, goal)
        build, search = self._functions(is_axis_aligned(scene), scene.mask.shape[-1])
        # Start and goal were tested too.
        sampling_checks, edge_checks, search_checks, planning_time = 2, 0, 0, 0.0
        roadmaps, nodes = 0, np.zeros((0, self.robot.num_dof))
        for key in jax.random.split(jax.random.key(seed), self.max_roadmaps):
            roadmaps += 1
            built = jax.block_until_ready(build(key, scene, start, goal, self.radius))
            sampling_checks += int(built.num_checks)
            searched = time.perf_counter()
            found, nodes = self._search_certified(search, built.roadmap, scene)
            planning_time += time.perf_counter() - searched
            edge_checks += int(found.edge_checks)
            search_checks += int(found.configuration_checks)
            if len(nodes):
                break
        total_time = time.perf_counter() - begin
        success = len(nodes) > 0
        cost = float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum()) if success else np.inf
        return Plan(
            success=success,
            reason=""
            if success
            else f"no path in the {roadmaps} roadmaps tried "
            f"({self.num_nodes} nodes, radius {self.radius:.2f})",
            path=nodes,
            cost=cost,
            certified=success,
            edge_checks=edge_checks,
            configuration_checks=sampling_checks + search_checks,
            sampling_checks=sampling_checks,
            search_checks=search_checks,
            planning_time_s=planning_time,
            total_time_s=total_time,
            roadmaps=roadmaps,
        )

    def _check_query(self, scene: Scene, start: ArrayLike, goal: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        robot = self.robot
        home = jnp.asarray(robot.home)
        clear = np.asarray(boxes_clear(robot, scene, home, base_only=True))
        if not clear.all():
            raise InputError(
                f"box {int(np.argmin(clear))} of the scene touches the base of {robot.name}; "
                "move it away"
            )
        ends = []
        for name, q in (("start", start), ("goal", goal)):
            try:
                q = np.asarray(q, dtype=np.float32)
            except (TypeError, ValueError):
                raise InputError(f"{name} {q!r} is not a list of numbers") from None
            if q.shape != (robot.num_dof,):
                raise InputError(
                    f"{name} has shape {q.shape}; {robot.name} needs {robot.num_dof} joint values"
                )
            bad = ~((q >= robot.joint_lower) & (q <= robot.joint_upper))
            if bad.any():
                joint = int(bad.argmax())
                raise InputError(
                    f"{name} has {q[joint]:.4g} for joint {joint + 1}; it must lie between "
                    f"{robot.joint_lower[joint]:.4g} and {robot.joint_upper[joint]:.4g}"
                )
            clearance = configuration_clearance(robot, scene, q)
            if clearance <= 0:
                raise InputError(
                    f"{name} {np.round(q, 4).tolist()} is in collision "
                    f"({-1e3 * clearance:.1f} mm deep); choose a free configuration"
                )
            ends.append(q)
        return ends[0], ends[1]

    def _search_certified(self, search, roadmap: Roadmap, scene: Scene):
        """Searches until a path is certified or there is none; refuted edges are searched around.

        Edges already known cost nothing when the search is run again.
        """
        status, reverse = unknown_edges(roadmap), None
        edge_checks, configuration_checks = 0, 0
        while True:
            found = jax.block_until_ready(search(roadmap, scene, status))
            edge_checks += int(found.edge_checks)
            configuration_checks += int(found.configuration_checks)
            found = found._replace(
                edge_checks=edge_checks, configuration_checks=configuration_checks
            )
            if not bool(found.success):
                return found, np.zeros((0, self.robot.num_dof), np.float32)
            walked = np.asarray(found.path)
            walked = walked[walked >= 0]
            nodes = np.asarray(roadmap.nodes)[walked]
            certified = certify_edges(self.robot, scene, nodes[:-1], nodes[1:])
            if certified.all():
                return found, nodes
            reverse = reverse_slots(roadmap) if reverse is None else reverse
            status = found.edge_status
            for i in np.flatnonzero(~certified):
                slots = np.asarray(roadmap.neighbors[walked[i]]) == walked[i + 1]
                slot = jnp.int32(np.argmax(slots))
                status = learn_edge(status, reverse, jnp.int32(walked[i]), slot, jnp.bool_(False))

    @functools.cache  # noqa: B019 - a planner lives as long as its compiled functions
    def _functions(self, axis_aligned: bool, max_boxes: int):
        """The two jitted halves of a query, for one padding of the scene."""
        checker = make_checker(
            self.robot, self.backend, axis_aligned=axis_aligned, max_boxes=max_boxes
        )
        bucket = node_bucket(self.num_nodes)
        slots = default_slots(bucket)
        lower, upper = self.robot.joint_lower, self.robot.joint_upper

        def build(
            key: jax.Array, scene: Scene, start: jax.Array, goal: jax.Array, radius: jax.Array
        ) -> _Built:
            samples = sample_free(
                key,
                functools.partial(checker.check_configurations, scene),
                lower,
                upper,
                bucket - 2,
                wanted=self.num_nodes - 2,
            )
            nodes = jnp.concatenate([jnp.stack([start, goal]), samples.nodes])
            mask = jnp.concatenate([jnp.ones(2, bool), samples.mask])
            roadmap = connect(nodes, mask, radius, slots)
            return _Built(roadmap, samples.num_checks, samples.mask.sum())

        def search(roadmap: Roadmap, scene: Scene, status: jax.Array) -> SearchResult:
            return search_roadmap(
                self.method, roadmap, functools.partial(checker.check_edges, scene), status
            )

        return jax.jit(build), jax.jit(search)


def search_roadmap(method: Method, roadmap: Roadmap, check_edges, status: jax.Array):
    """Searches one roadmap by a named method.

    Args:
        method: see `load_planner`.
        roadmap: one roadmap.
        check_edges: `(starts [E D], ends [E D]) -> EdgeChecks [E]`.
        status: what is known of its edges.
    """

    def check_edge(start: Float[Array, " D"], end: Float[Array, " D"]) -> EdgeChecks:
        checks = check_edges(start[None], end[None])
        return EdgeChecks(checks.valid[0], checks.num_checks[0])

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


def cache_compilations() -> None:
    """Keeps compiled code in the user's cache folder, unless JAX was already told where."""
    if jax.config.jax_compilation_cache_dir is None:
        folder = Path.home() / ".cache" / "gnnjax" / "jax"
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
