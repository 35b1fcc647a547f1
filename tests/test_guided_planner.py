"""The default planner end to end: what it finds, laws, and bad input."""

import dataclasses
import gc
import itertools
import json
import weakref
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.errors import InputError
from gnnjax.guide.motion import MotionNetwork, motion_guide
from gnnjax.plan import PlanConfig
from gnnjax.plan import main as plan_once
from gnnjax.planning.engine import Run
from gnnjax.planning.load import load_planner, make_planner
from gnnjax.planning.options import PlannerOptions, make_options
from gnnjax.planning.planner import Planner
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import default_slots, node_bucket
from gnnjax.roadmap.stored import insert_ends, stored_roadmap
from gnnjax.scene.scene import make_scene
from tests.queries import check_path, one, random_problem, same

NUM_NODES = 40
# Two boxes that leave the first joint no way round, and a box above the base.
WALLED = make_scene(
    [[0.6, 0, 0], [-0.6, 0, 0], [0, 0, 1.2]], [[0.45, 0.02, 1], [0.45, 0.02, 1], [0.5, 0.02, 0.9]]
)

pytestmark = pytest.mark.usefixtures("all_sizes")


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def network():
    """Untrained: paths are found whatever it says."""
    return MotionNetwork(num_points=3, channels=8, rngs=nnx.Rngs(0))


@pytest.fixture(scope="module")
def planner(robot, network):
    """Compiled once, for boxes that are not rotated."""
    return make(robot, network)


def make(robot, network, **options):
    # Where checks are cheap, there are trees in place of roadmaps.
    own = {"num_nodes": NUM_NODES, "max_roadmaps": 2, "check_cost": 100.0}
    options = make_options("guided", **own | options)
    guide = None if network is None else motion_guide(robot, network)
    return make_planner(robot, options, guide)


def with_options(planner, **changes):
    """The same compiled functions under other limits."""
    return dataclasses.replace(planner.options, **changes)


@pytest.fixture(scope="module")
def problems(robot):
    """Eight random ones, and one without a path."""
    rng = np.random.default_rng(0)
    walled = Problem(np.float32([-1.5, 0, 0]), np.float32([1.5, 0, 0]), WALLED)
    drawn = [*(random_problem(robot, rng) for _ in range(8)), walled]
    return jax.tree.map(lambda *x: np.stack(x), *drawn)


@pytest.fixture(scope="module")
def plans(planner, problems):
    return planner.plan_batch(problems)


def test_paths_are_certified_and_counts_add_up(robot, problems, plans):
    assert sum(plan.success for plan in plans) >= 6
    for i, plan in enumerate(plans):
        assert plan.configuration_checks == plan.sampling_checks + plan.search_checks
        assert plan.sampling_checks == 2  # start and goal; no node is tested before it is wanted
        assert plan.total_time_s >= plan.planning_time_s > 0
        if plan.success:
            check_path(robot, one(problems, i), plan)
            assert plan.edge_checks >= 1


def test_a_planner_that_nobody_holds_is_freed_with_all_that_it_compiled(robot, network, problems):
    planner = make(robot, network)
    assert planner.plan_batch(jax.tree.map(lambda x: x[:1], problems))[0].roadmaps == 1
    kept = [planner, planner.strategy, planner._tester(True), planner.strategy.looks.edges]
    names = [type(x).__name__ for x in kept]
    kept = [weakref.ref(x) for x in kept]
    del planner
    gc.collect()
    assert [name for name, ref in zip(names, kept, strict=True) if ref() is not None] == []


def test_where_there_is_no_path_it_says_so(plans):
    plan = plans[-1]
    assert not plan.success
    assert not plan.certified
    assert plan.reason.startswith(f"no path in the 2 roadmaps tried ({NUM_NODES} nodes, then 400 ")
    assert plan.reason.endswith("rounds; more effort may find one")
    assert plan.path.shape == (0, 3)
    assert plan.cost == np.inf
    assert plan.roadmaps == 2
    assert plan.edge_checks > 0
    assert plan.search_checks > 0


def test_a_batch_equals_a_loop(planner, problems, plans):
    loop = [planner.plan(p.scene, p.start, p.goal) for p in (one(problems, i) for i in range(9))]
    assert same(loop, plans)


def test_the_seed_alone_decides(planner, problems, plans):
    assert same(planner.plan_batch(problems), plans)
    others = planner.plan_batch(problems, seed=1)
    assert not same(others, plans)
    assert not others[-1].success


def test_a_path_is_found_wherever_the_roadmap_has_one(robot, planner, monkeypatch):
    monkeypatch.setattr(planner, "options", with_options(planner, max_roadmaps=1, effort=100))
    # They would make up for a path that the search misses, and take long where there is none.
    monkeypatch.setattr(Run, "_grow_trees", lambda run: None)
    stored = stored_roadmap(robot, NUM_NODES - 2, 0)
    checker = make_checker(robot, axis_aligned=True)

    @jax.jit
    def check(problem):
        roadmap = insert_ends(stored, problem.start, problem.goal, planner.radius)
        starts = jnp.repeat(roadmap.nodes, roadmap.neighbors.shape[1], axis=0)
        ends = roadmap.nodes[roadmap.neighbors.ravel()]
        node = checker.check_configurations(problem.scene, roadmap.nodes)
        edge = checker.check_edges(problem.scene, starts, ends).valid
        edge = edge.reshape(roadmap.neighbors.shape) & roadmap.neighbor_mask
        return roadmap, edge & node[:, None] & node[roadmap.neighbors]

    outcomes, rng = [], np.random.default_rng(1)
    for _ in range(12):
        problem = random_problem(robot, rng, num=9)
        roadmap, valid = jax.tree.map(np.asarray, check(problem))
        near, slot = np.nonzero(valid)
        far = roadmap.neighbors[near, slot]
        proven = certify_edges(robot, problem.scene, roadmap.nodes[near], roadmap.nodes[far])
        graph = csr_matrix((proven, (near, far)), (len(valid), len(valid)))
        parts = connected_components(graph, directed=False)[1]
        plan = planner.plan(problem.scene, problem.start, problem.goal)
        # A shortened path may be free where the roadmap's are not, but not the other way round.
        assert plan.success >= (parts[0] == parts[1])
        outcomes.append(plan.success)
    assert set(outcomes) == {True, False}


def test_other_weights_take_effect_and_nothing_is_compiled_again(planner, network, problems, plans):
    strategy = planner.strategy
    functions = [strategy._first, strategy._later, strategy.looks.edges, strategy.looks.shortcuts]
    sizes = [f._cache_size() for f in functions]
    other = MotionNetwork(network.num_points, network.channels, rngs=nnx.Rngs(7))
    planner.use_weights(nnx.state(other))
    try:
        found = planner.plan_batch(problems)
    finally:
        planner.use_weights(nnx.state(network))
    assert not same(found, plans)
    assert [plan.success for plan in found][-1:] == [False]
    assert same(planner.plan_batch(problems), plans)
    assert [f._cache_size() for f in functions] == sizes


def test_roadmaps_of_tested_nodes_and_paths_as_they_are(robot, network, problems, monkeypatch):
    planner = make(robot, network, shorten=False, sampled=True)
    slots, enter = [], planner.strategy.enter

    def note(*args):
        entered = enter(*args)
        slots.append(entered.priced.price.shape[-1])
        return entered

    monkeypatch.setattr(planner.strategy, "enter", note)
    found = planner.plan_batch(problems)
    assert set(slots) == {default_slots(node_bucket(NUM_NODES))}  # all edges are searched
    assert sum(plan.success for plan in found) >= 5
    assert not found[-1].success
    nodes = 0
    for i, plan in enumerate(found):
        assert plan.sampling_checks >= plan.roadmaps * (NUM_NODES - 2) + 2
        if plan.success:
            check_path(robot, one(problems, i), plan)
            nodes = max(nodes, len(plan.path))
    assert nodes > 2


def test_no_roadmap_is_begun_after_the_time_limit(planner, problems, monkeypatch):
    monkeypatch.setattr(planner, "options", with_options(planner, time_limit=1e-9))
    for plan in planner.plan_batch(problems):
        assert plan.roadmaps == 1
        assert plan.success or "no path in the 0 roadmaps tried" in plan.reason


def test_a_scene_without_boxes(robot, planner):
    empty = make_scene([], [])
    start, goal = np.float32([-2, 1, 0]), np.float32([2, -1, 1])
    plan = planner.plan(empty, start, goal)
    assert plan.success
    check_path(robot, Problem(start, goal, empty), plan)


def free_corner(robot, scene):
    """A corner of the joint limits where the arm is free."""
    for q in itertools.product(*zip(robot.joint_lower, robot.joint_upper, strict=True)):
        if configuration_clearance(robot, scene, np.float32(q)) > 0:
            return np.float32(q)
    raise AssertionError("no corner is free")


@pytest.mark.parametrize("corner", [False, True])
def test_a_start_that_is_the_goal_has_a_path_without_length(robot, planner, corner):
    scene = make_scene([[0.6, 0, -0.6]], [[0.1, 0.1, 0.1]])
    q = free_corner(robot, scene) if corner else np.float32([0.5, 1.0, 0.0])
    plan = planner.plan(scene, q, q)
    assert plan.success
    assert plan.cost == 0.0
    np.testing.assert_array_equal(plan.path, [q, q])


def test_a_start_in_a_corner_of_the_limits(robot, planner):
    # Where many of the nodes drawn around it are the corner itself. The second roadmap is the first
    # that has such nodes, so the direct way must not be free.
    rng, later = np.random.default_rng(3), 0
    for _ in range(30):
        problem = random_problem(robot, rng, num=9)
        try:
            start = free_corner(robot, problem.scene)
        except AssertionError:
            continue
        plan = planner.plan(problem.scene, start, problem.goal)
        if plan.success:
            check_path(robot, Problem(start, problem.goal, problem.scene), plan)
            later += plan.roadmaps > 1
        if later:
            break
    assert later >= 1


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ([0.0, 0.0], r"start has shape \(2,\); tiny needs 3 joint values"),
        ([0.0, float("nan"), 0.0], "start has nan for joint b; it must lie between"),
        ([0.0, 0.0, 0.0], "start .* is in collision"),
    ],
)
def test_a_bad_start_is_refused_with_its_value(planner, start, message):
    with pytest.raises(InputError, match=message):
        planner.plan(make_scene([[0.6, 0, 0]], [[0.1, 0.1, 0.1]]), start, [2.0, 0.0, 0.0])


def test_a_box_in_the_base_is_refused(planner):
    scene = make_scene([[0.0, 0.0, 0.1]], [[0.05, 0.05, 0.05]])
    with pytest.raises(InputError, match=r"box 0 of the scene reaches .* mm into the base of tiny"):
        planner.plan(scene, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_nodes": 1}, "num_nodes is 1; a roadmap needs at least start and goal"),
        ({"num_nodes": 19}, "num_nodes is 19; planner 'guided' needs at least 20"),
        ({"max_roadmaps": 0}, "max_roadmaps is 0"),
        ({"checker": "magic"}, "no checker 'magic'; there are"),
        ({"time_limit": float("nan")}, "time_limit is nan"),
        ({"resolution": 0.0}, "resolution is 0.0"),
    ],
)
def test_bad_settings_are_refused(robot, network, change, message):
    with pytest.raises(InputError, match=message):
        make(robot, network, **change)


def test_it_is_the_default_and_needs_no_weights_of_the_arm(tiny_path):
    planner = load_planner(tiny_path)
    assert isinstance(planner, Planner)
    config = PlanConfig(scene=Path(), start=(), goal=())
    assert config.planner == planner.options.planner == PlannerOptions().planner == "guided"


@pytest.mark.parametrize(
    ("boxes", "ends", "message"),
    [
        (
            [[0.0, 0.0, 0.1]],
            ((-1.5, 0.0, 0.0), (1.5, 0.0, 0.0)),
            "box 0 of the scene reaches .* mm into the base",
        ),
        (
            [[0.6, 0.0, 0.0]],
            ((float("nan"), 0.0, 0.0), (1.5, 0.0, 0.0)),
            "start has nan for joint a",
        ),
        (
            [[0.6, 0.0, 0.0]] * 129,
            ((-1.5, 0.0, 0.0), (1.5, 0.0, 0.0)),
            "has 129 obstacles; at most 128 are",
        ),
    ],
)
def test_the_command_refuses_before_it_plans(tiny_path, tmp_path, boxes, ends, message):
    path, size = tmp_path / "scene.json", [0.05, 0.05, 0.05]
    path.write_text(json.dumps({"boxes": [{"center": c, "half_extents": size} for c in boxes]}))
    config = PlanConfig(
        scene=path, start=ends[0], goal=ends[1], robot=str(tiny_path), out=tmp_path / "path.npz"
    )
    with pytest.raises(InputError, match=message):
        plan_once(config)
    assert [file.name for file in tmp_path.iterdir()] == ["scene.json"]
