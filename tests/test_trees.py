"""Trees and shortcuts: what they find holds, and does not depend on who is planned beside."""

import jax
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_path
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import clearances
from gnnjax.collision.sequences import Items, SequenceTester
from gnnjax.planning import trees
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.progress import Progress
from gnnjax.planning.query import path_length
from gnnjax.planning.shortcuts import _POINTS, _shortest, _spread, cut_short
from gnnjax.planning.trees import DRAWN, Outlook, Tree, _likely, grow
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import make_scene


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def tester(robot):
    return SequenceTester(robot, make_checker(robot), 0.05)


@pytest.fixture(scope="module")
def problems(robot):
    rng, drawn = np.random.default_rng(0), []
    while len(drawn) < 12:
        centers = rng.uniform(-0.8, 0.8, (6, 3))
        centers *= np.maximum(1, 0.5 / np.linalg.norm(centers, axis=1))[:, None]
        scene = make_scene(centers, rng.uniform(0.05, 0.22, (6, 3)), rng.normal(size=(6, 4)))
        ends = rng.uniform(robot.joint_lower, robot.joint_upper, (2, 3)).astype(np.float32)
        if (clearances(robot, scene, ends) > 0).all():
            drawn.append(Problem(*ends, scene))
    return jax.tree.map(lambda *x: np.stack(x), *drawn)


@pytest.fixture(scope="module")
def strategy(robot):
    return make_planner(robot, PlannerOptions(num_nodes=32)).strategy


def grown(robot, strategy, tester, problems, effort=1, time_limit=np.inf, defers=False):
    progress = Progress(robot, problems)
    progress.defers = defers
    placed, ids = tester.place(progress.problems.scene), np.arange(len(problems.start))
    outlook = Outlook(progress, strategy, ids, 2)
    grow(robot, progress, tester, placed, ids, outlook, 0, effort, time_limit)
    return progress, placed


def test_trees_find_certified_paths_which_shortcuts_make_shorter(robot, strategy, tester, problems):
    progress, placed = grown(robot, strategy, tester, problems)
    solved = np.flatnonzero([path is not None for path in progress.paths])
    assert len(solved) >= 10
    before = [path_length(progress.paths[i]) for i in solved]
    checks = progress.search_checks.copy()
    cut_short(progress, tester, placed, solved)
    after = [path_length(progress.paths[i]) for i in solved]
    assert (np.array(after) <= np.array(before) + 1e-5).all()
    assert sum(after) < 0.98 * sum(before)
    assert progress.search_checks.sum() > checks.sum()
    for i in solved:
        path = progress.paths[i]
        np.testing.assert_array_equal(path[[0, -1]], [problems.start[i], problems.goal[i]])
        assert certify_path(robot, jax.tree.map(lambda x, i=i: x[i], problems.scene), path)


def test_paths_whose_certificate_is_to_wait_get_it_later(
    robot, strategy, tester, problems, monkeypatch
):
    at_once, _ = grown(robot, strategy, tester, problems)
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "certify", None)  # nobody asks for one meanwhile
        later, _ = grown(robot, strategy, tester, problems, defers=True)
    assert all(path is None for path in later.paths)
    np.testing.assert_array_equal(later.search_checks, at_once.search_checks)
    later.prove()
    for path, other in zip(later.paths, at_once.paths, strict=True):
        np.testing.assert_array_equal(path, other)


def test_a_problem_has_the_same_path_alone(robot, strategy, tester, problems):
    together, placed = grown(robot, strategy, tester, problems)
    cut_short(together, tester, placed, np.flatnonzero([p is not None for p in together.paths]))
    for i in (0, 3, 7):
        alone, scene = grown(
            robot, strategy, tester, jax.tree.map(lambda x, i=i: x[i : i + 1], problems)
        )
        if alone.paths[0] is None:
            assert together.paths[i] is None
            continue
        cut_short(alone, tester, scene, np.zeros(1, int))
        np.testing.assert_array_equal(alone.paths[0], together.paths[i])
        assert alone.search_checks[0] == together.search_checks[i]
        assert alone.rounds[0] == together.rounds[i]


def test_the_guide_picks_the_branches(robot, strategy, tester, problems):
    """Of a guide that knows what is free, fewer are blocked."""
    progress = Progress(robot, problems)
    rows = np.arange(len(problems.start))
    tree = Tree(problems.start, 10)
    goals = np.random.default_rng(2).uniform(
        robot.joint_lower, robot.joint_upper, (len(rows), DRAWN, 3)
    )
    outlook = Outlook(progress, strategy, rows, 2)
    row, near, picked = _likely(tree, outlook, rows, goals.astype(np.float32))
    assert not near.any()
    assert sorted(set(row.tolist())) == rows.tolist()
    every = np.repeat(rows, DRAWN), goals.reshape(-1, 3)
    share = {}
    for name, (own, ends) in {"picked": (row, picked), "every": every}.items():
        ends = ends.astype(np.float32)
        items = Items(np.arange(len(own)), own, problems.start[own], ends, np.ones(len(own), bool))
        outcome = tester(tester.place(problems.scene), items, len(own))
        share[name] = outcome.refuted.mean()
    assert share["picked"] < 0.8 * share["every"]


def test_no_time_grows_nothing(robot, strategy, tester, problems):
    progress, _ = grown(robot, strategy, tester, problems, time_limit=-1.0)
    assert all(path is None for path in progress.paths)
    assert not progress.rounds.any()


def test_the_nearest_nodes_are_those_of_all_distances(monkeypatch):
    rng = np.random.default_rng(8)
    nodes, q = (rng.normal(size=(n, 7)).astype(np.float32) for n in (90, 12))
    tree = Tree(nodes[:2], room=100)
    for number, row in enumerate(np.repeat([0, 1], [60, 28])):
        tree.add(int(row), 0, nodes[2 + number, None])
    of = [[0, *range(2, 62)], [1, *range(62, 90)]]
    wanted = [np.linalg.norm(nodes[rows] - q[:, None], axis=-1).argmin(axis=1) for rows in of]
    both = np.stack([q, q])
    np.testing.assert_array_equal(tree.nearest(np.arange(2), both), wanted)
    monkeypatch.setattr(trees, "_PRODUCT", 7 * 12 * 8)  # blocks of eight nodes
    np.testing.assert_array_equal(tree.nearest(np.array([1, 0]), both), wanted[::-1])


def test_a_full_tree_stays_as_it_is():
    tree = Tree(np.zeros((1, 2), np.float32), 3)
    assert tree.add(0, 0, np.ones((5, 2), np.float32)) == 2
    assert tree.add(0, 1, np.ones((1, 2), np.float32)) == 1
    assert tree.count[0] == 3
    assert len(tree.way(0, 2)) == 3


def test_points_of_a_path_hold_its_corners_and_the_shortest_way_is_dijkstras():
    rng = np.random.default_rng(1)
    path = rng.normal(size=(5, 3)).astype(np.float32)
    points, edge = _spread(path)
    assert len(points) == _POINTS
    for corner in path:
        assert (points == corner).all(axis=1).any()
    assert (np.diff(edge) >= 0).all()
    lengths = np.linalg.norm(points[None] - points[:, None], axis=2)
    first, second = np.triu_indices(_POINTS, 1)
    allowed = rng.random(len(first)) < 0.3
    allowed |= second == first + 1
    cost = np.where(allowed, lengths[first, second], np.inf)
    found = _shortest(points, cost)
    best = np.full(_POINTS, np.inf)
    best[0] = 0
    for _ in range(_POINTS):
        np.minimum.at(best, second, best[first] + cost)
    assert path_length(found) == pytest.approx(best[-1], rel=1e-5)
