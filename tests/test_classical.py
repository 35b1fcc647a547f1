"""Planners of OMPL: what they find, what is counted, and what is refused."""

import itertools
import json
import sys

import jax
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.baselines.ledger import Ledger
from gnnjax.baselines.ompl import ClassicalPlanner
from gnnjax.collision.certify import certify_path
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.generate import GenerateConfig, generate
from gnnjax.measure.rows import within
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import make_options
from gnnjax.planning.planner import Planner
from gnnjax.scene.scene import make_scene
from tests.fine_scan import collides_anywhere

PLANNERS = ["ompl:rrt_connect", "ompl:rrt_star", "ompl:bit_star", "ompl:prm"]
CHECKERS = ["fused", "mujoco"]
NUM_BOXES = 3  # in all scenes here, so that little is compiled


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def blocked(walled):
    """A problem without a solution: only joint a turns past the walls, and they are a ring."""
    angles = np.array([0.4, -0.4, 0.0])
    centers = np.stack([0.42 * np.cos(angles), 0.42 * np.sin(angles), 0 * angles], axis=1)
    scene = make_scene(centers, np.full((3, 3), 0.2), max_obstacles=3)
    return walled._replace(scene=jax.tree.map(lambda x: np.asarray(x)[None], scene))


@pytest.fixture(scope="module")
def planners(robot):
    """One planner of each kind, made once."""
    return {
        (method, checker): classical(robot, method, checker=checker)
        for method, checker in itertools.product(PLANNERS, CHECKERS)
    }


@pytest.mark.parametrize("checker", CHECKERS)
@pytest.mark.parametrize("method", PLANNERS)
def test_paths_join_start_and_goal_and_hold(robot, walled, planners, method, checker):
    (plan,) = planners[method, checker].plan_batch(walled)
    scene = jax.tree.map(lambda x: x[0], walled.scene)
    assert plan.success
    assert plan.path.dtype == np.float32
    np.testing.assert_array_equal(plan.path[[0, -1]], [walled.start[0], walled.goal[0]])
    assert plan.certified == certify_path(robot, scene, plan.path)
    assert plan.certified or not collides_anywhere(robot, scene, plan.path, step=0.05)
    length = np.linalg.norm(np.diff(plan.path, axis=0), axis=1).sum()
    np.testing.assert_allclose(plan.cost, length, rtol=1e-5)
    assert plan.configuration_checks == plan.sampling_checks + plan.search_checks
    assert plan.sampling_checks >= 2
    assert plan.edge_checks >= len(plan.path) - 1
    assert plan.roadmaps == 1
    assert plan.total_time_s > plan.planning_time_s > 0


def test_ends_are_taken_from_who_made_sure_of_them(robot, walled, monkeypatch):
    """By a finer test than the kernels, which may refuse what is just free."""
    planner = classical(robot, "ompl:rrt_connect")
    ends = {walled.start[0].tobytes(), walled.goal[0].tobytes()}
    checks = (lambda q: q.tobytes() not in ends), (lambda start, end: True)
    monkeypatch.setattr(planner, "_checks_maker", lambda *of: lambda scene, ledger: checks)
    (plan,) = planner.plan_batch(walled)
    assert plan.success
    np.testing.assert_array_equal(plan.path[[0, -1]], [walled.start[0], walled.goal[0]])


@pytest.mark.parametrize("method", PLANNERS[:3])
def test_a_seed_repeats_paths_and_counts(walled, planners, method):
    """But for PRM, which looks for a path in a thread of its own while the roadmap grows."""
    planner = planners[method, "mujoco"]
    first, again, other = (planner.plan_batch(walled, seed=s)[0] for s in (3, 3, 4))
    np.testing.assert_array_equal(first.path, again.path)
    assert first.configuration_checks == again.configuration_checks
    assert first.edge_checks == again.edge_checks
    assert not np.array_equal(first.path, other.path)


@pytest.mark.parametrize("checker", CHECKERS)
def test_counts_are_those_of_a_recount(robot, walled, checker, monkeypatch):
    """All that OMPL asks is written down and counted again, edge by edge, by other code."""
    asked = []
    for name in ("know", "know_edge"):
        plain = getattr(Ledger, name)

        def noted(self, *arguments, name=name, plain=plain):
            if not self._along_edge:  # not the points that OMPL takes along an edge
                asked.append((name, arguments[:-1]))
            return plain(self, *arguments)

        monkeypatch.setattr(Ledger, name, noted)
    planner = classical(robot, "ompl:rrt_connect", checker=checker)
    (plan,) = planner.plan_batch(walled, seed=1)
    scene = jax.tree.map(lambda x: x[0], walled.scene)
    tested, edges, sampling, search = {}, set(), 0, 0

    def valid(q):
        return configuration_clearance(robot, scene, q) > 0

    for name, ends in asked:
        if name == "know":
            q = ends[0]
            if q.tobytes() not in tested:
                tested[q.tobytes()] = valid(q)
                sampling += 1
            continue
        start, end = ends
        key = frozenset((start.tobytes(), end.tobytes()))
        if key in edges:
            continue
        edges.add(key)
        for q in points_along(start, end, checker):
            if q.tobytes() not in tested:
                tested[q.tobytes()] = valid(q)
                search += 1
            if not tested[q.tobytes()]:
                break
    assert plan.edge_checks == len(edges)
    assert plan.sampling_checks == sampling
    assert plan.search_checks == search


def classical(robot, planner="ompl:rrt_connect", **options):
    return ClassicalPlanner(robot, make_options(planner, **{"time_limit": 5.0, **options}))


def points_along(start, end, checker):
    """End, then halves, quarters, ...; in double precision and from the start as OMPL takes them,
    or in single precision and from the smaller end as the fused kernel does."""
    yield end
    if checker == "fused":
        low, high = sorted((start, end), key=lambda q: q.tolist())
    else:
        low, high = start.astype(float), end.astype(float)
    count = int(np.ceil(np.linalg.norm(high - low) / 0.05))
    spans = [(1, count - 1)] if checker == "mujoco" else [(0, count)]
    for first, last in spans:  # grows while it is walked
        middle = (first + last) // 2
        if checker == "mujoco":
            if first > last:
                continue
            spans += [(first, middle - 1), (middle + 1, last)]
        else:
            if middle == first:
                continue
            spans += [(first, middle), (middle, last)]
        fraction = low.dtype.type(middle) / low.dtype.type(count)
        yield (low + fraction * (high - low)).astype(np.float32)


def test_no_path_in_time_is_a_failure(robot, blocked):
    planner = classical(robot, time_limit=0.2, checker="mujoco")
    (plan,) = planner.plan_batch(blocked)
    assert not plan.success
    assert plan.reason == "no path within 0.2 s"
    assert len(plan.path) == 0
    assert not plan.certified
    assert np.isinf(plan.cost)
    assert plan.total_time_s > 0.1


@pytest.mark.parametrize("checker", CHECKERS)
@pytest.mark.parametrize("method", PLANNERS[:3])
def test_a_simplified_path_is_shorter_and_holds_and_its_checks_count(
    robot, walled, planners, method, checker
):
    """Not PRM, whose first path is another one each time."""
    simplifying = classical(robot, method, checker=checker, simplify=True)
    scene = jax.tree.map(lambda x: x[0], walled.scene)
    shorter = 0
    for seed in range(4):
        (plain,) = planners[method, checker].plan_batch(walled, seed=seed)
        (plan,) = simplifying.plan_batch(walled, seed=seed)
        assert plan.success
        assert plan.cost <= plain.cost + 1e-5
        shorter += plan.cost < plain.cost - 1e-3
        np.testing.assert_array_equal(plan.path[[0, -1]], [walled.start[0], walled.goal[0]])
        assert all(holds(robot, scene, *ends, checker) for ends in itertools.pairwise(plan.path))
        assert plan.certified == certify_path(robot, scene, plan.path)
        for name in ("edge_checks", "sampling_checks", "search_checks", "configuration_checks"):
            assert getattr(plan, name) >= getattr(plain, name)
        assert plan.total_time_s > plan.planning_time_s > 0
    assert shorter > 0


def holds(robot, scene, start, end, checker):
    """Tests an edge point by point, without a ledger."""
    points = [start, *points_along(start, end, checker)]
    return all(configuration_clearance(robot, scene, q) > 0 for q in points)


def test_simplifying_repeats_with_its_seed(robot, walled):
    planner = classical(robot, checker="mujoco", simplify=True)
    first, again = (planner.plan_batch(walled, seed=3)[0] for _ in range(2))
    np.testing.assert_array_equal(first.path, again.path)
    assert first.configuration_checks == again.configuration_checks


def test_a_simplified_path_that_does_not_hold_is_left(robot, walled, planners, monkeypatch):
    from ompl import geometric

    def straight(simplifier, path, seconds, at_least_once):
        """Through the walls."""
        made = geometric.PathGeometric(path)
        path.clear()
        path.append(made.getState(0))
        path.append(made.getState(made.getStateCount() - 1))
        return True

    monkeypatch.setattr(geometric.PathSimplifier, "simplify", straight)
    planner = classical(robot, "ompl:rrt_connect", checker="mujoco", simplify=True)
    (plain,) = planners["ompl:rrt_connect", "mujoco"].plan_batch(walled)
    (plan,) = planner.plan_batch(walled)
    np.testing.assert_array_equal(plan.path, plain.path)
    assert plan.edge_checks == plain.edge_checks + 1  # the edge that does not hold


def test_simplifying_ends_with_the_time(robot, walled, planners, monkeypatch):
    """The path that was found is then the answer, and nothing more is tested."""
    monkeypatch.setattr("gnnjax.baselines.ompl._CLOSING_S", 5.0)
    planner = classical(robot, checker="mujoco", simplify=True, time_limit=5.0)
    (plain,) = planners["ompl:rrt_connect", "mujoco"].plan_batch(walled)
    (plan,) = planner.plan_batch(walled)
    np.testing.assert_array_equal(plan.path, plain.path)
    assert plan.configuration_checks == plain.configuration_checks


def test_a_path_that_comes_too_late_is_a_failure():
    row = {"success": True, "total_time_s": 2.0, "path": [[0.0]], "cost": 1.0, "certified": True}
    assert within(row, 2.5) == row
    late = within(row, 1.5)
    assert not late["success"]
    assert not late["certified"]
    assert late["path"] == []
    assert late["cost"] is None
    assert late["reason"] == "a path after 2.00 s, and the limit is 1.5 s"


@pytest.fixture(scope="module")
def problems(tiny_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("problems") / "three.npz"
    generate(GenerateConfig(split="test", robot=str(tiny_path), num_problems=3, seed=3, out=path))
    return path


def config(tiny_path, problems, out, **changes):
    settings = {"planner": "ompl:rrt_connect", "checker": "mujoco"} | changes
    return EvaluateConfig(problems=problems, json=out, robot=str(tiny_path), **settings)


def test_evaluate_writes_their_results(tiny_path, problems, tmp_path):
    out = tmp_path / "out.json"
    evaluate(config(tiny_path, problems, out))
    results = json.loads(out.read_text())
    assert results["complete"]
    assert results["machine"]["ompl"]
    assert results["summary"]["all"]["success"] == 1.0
    certified = np.mean([row["certified"] for row in results["problems"]])
    assert results["summary"]["all"]["certified"] == certified
    half = {**results, "problems": results["problems"][:2], "complete": False}
    out.write_text(json.dumps(half))
    resumed = evaluate(config(tiny_path, problems, out))
    assert resumed["problems"][2]["path"] == results["problems"][2]["path"]


def test_without_ompl_it_alone_is_missing(tiny_path, problems, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)
    with pytest.raises(InputError, match=r"OMPL is not installed; pip install 'gnnjax\[experim"):
        evaluate(config(tiny_path, problems, tmp_path / "out.json"))
    assert not (tmp_path / "out.json").exists()
    ours = config(tiny_path, problems, tmp_path / "x.json", planner="distance", checker="fused")
    assert isinstance(make_planner(load_robot(tiny_path), ours), Planner)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"checker": "mjx"},
            r"'mjx' with planner 'ompl:rrt_connect'; it takes \['fused",
        ),
        (
            {"planner": "lazysp"},
            r"'mujoco' with planner 'lazysp'; it takes \['fused",
        ),
        (
            {"planner": "lazysp", "checker": "fused", "simplify": True},
            "^simplify with planner 'lazysp'; it is for OMPL's planners, leave it out$",
        ),
        ({"resolution": 0.0}, "resolution is 0.0; it must be at least"),
        ({"time_limit": 0.0}, "time_limit is 0.0; it must be more than 0 s"),
    ],
)
def test_bad_settings_are_refused(tiny_path, problems, tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        evaluate(config(tiny_path, problems, tmp_path / "out.json", **changes))


def test_a_planner_that_ompl_lacks_is_named(robot, monkeypatch):
    from ompl import geometric

    monkeypatch.delattr(geometric, "RRTConnect")
    with pytest.raises(InputError, match=r"OMPL [\d.]+ has no planner 'ompl:rrt_connect'; OMPL 1"):
        classical(robot)


def test_states_are_freed_with_their_query(planners, walled):
    """OMPL's objects and Python's refer to each other; a cycle would keep every query's tree."""
    import gc

    planner = planners["ompl:rrt_connect", "mujoco"]
    planner.plan_batch(walled)
    gc.collect()
    before = sum(isinstance(x, Ledger) for x in gc.get_objects())
    for _ in range(3):
        planner.plan_batch(walled)
    gc.collect()
    assert sum(isinstance(x, Ledger) for x in gc.get_objects()) == before


def test_our_planners_begin_no_roadmap_after_the_limit(robot, blocked):
    def planner(**options):
        options = make_options("distance", num_nodes=20, max_roadmaps=3, **options)
        return make_planner(robot, options)

    assert planner(time_limit=1e-9).plan_batch(blocked)[0].roadmaps == 1
    assert planner().plan_batch(blocked)[0].roadmaps == 3
