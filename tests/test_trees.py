"""Trees and shortcuts: what they find holds, and does not depend on who is planned beside."""

import jax
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_path
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import clearances
from gnnjax.collision.sequences import Items, Outcome, SequenceTester
from gnnjax.planning import trees
from gnnjax.planning.batch import Batch
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.progress import Limits, Progress
from gnnjax.planning.query import path_length
from gnnjax.planning.shorten_by_tests import _POINTS, _cut, _shortest, _spread, cut_short
from gnnjax.planning.tree import Tree
from gnnjax.planning.trees import CHEAPLY, DRAWN, SPARINGLY, Outlook, _likely, grow
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


def grown(robot, strategy, tester, problems, time_limit=np.inf, defers=False):
    batch = Batch(robot, problems, Limits(time_limit), tester)
    batch.defers = defers
    ids = np.arange(len(problems.start))
    grow(batch, ids, Outlook(batch, strategy, ids, 2), 0, CHEAPLY, CHEAPLY.rounds)
    return batch


def branch(tree, parent, nodes):
    nodes = np.asarray(nodes, np.float32)
    return int(tree.add(np.array([parent]), np.array([len(nodes)]), nodes)[0])


def test_trees_find_certified_paths_which_shortcuts_make_shorter(robot, strategy, tester, problems):
    progress = grown(robot, strategy, tester, problems)
    solved = np.flatnonzero([path is not None for path in progress.paths])
    assert len(solved) >= 10
    before = [path_length(progress.paths[i]) for i in solved]
    checks = progress.search_checks.copy()
    cut_short(progress, solved)
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
    at_once = grown(robot, strategy, tester, problems)
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "certify", None)  # nobody asks for one meanwhile
        later = grown(robot, strategy, tester, problems, defers=True)
    assert all(path is None for path in later.paths)
    np.testing.assert_array_equal(later.search_checks, at_once.search_checks)
    later.prove()
    for path, other in zip(later.paths, at_once.paths, strict=True):
        np.testing.assert_array_equal(path, other)


def test_branches_may_be_tested_in_parts(robot, strategy, tester, problems, monkeypatch):
    at_once = grown(robot, strategy, tester, problems)
    monkeypatch.setattr(trees, "_BRANCHES_AT_ONCE", 7)
    in_parts = grown(robot, strategy, tester, problems)
    for path, other in zip(in_parts.paths, at_once.paths, strict=True):
        np.testing.assert_array_equal(path, other)
    np.testing.assert_array_equal(in_parts.search_checks, at_once.search_checks)


def test_a_problem_has_the_same_path_alone(robot, strategy, tester, problems):
    together = grown(robot, strategy, tester, problems)
    cut_short(together, np.flatnonzero([p is not None for p in together.paths]))
    for i in (0, 3, 7):
        alone = grown(robot, strategy, tester, jax.tree.map(lambda x, i=i: x[i : i + 1], problems))
        if alone.paths[0] is None:
            assert together.paths[i] is None
            continue
        cut_short(alone, np.zeros(1, int))
        np.testing.assert_array_equal(alone.paths[0], together.paths[i])
        assert alone.search_checks[0] == together.search_checks[i]
        assert alone.rounds[0] == together.rounds[i]


def test_the_guide_picks_the_branches(robot, strategy, tester, problems):
    """Of a guide that knows what is free, fewer are blocked."""
    progress = Progress(robot, problems, Limits())
    rows = np.arange(len(problems.start))
    own, others = ([Tree(root) for root in x] for x in (problems.start, problems.goal))
    goals = np.random.default_rng(2).uniform(
        robot.joint_lower, robot.joint_upper, (len(rows), DRAWN, 3)
    )
    outlook = Outlook(progress, strategy, rows, 2)
    row, near, picked = _likely(
        own, others, outlook, rows, goals.astype(np.float32), 0, CHEAPLY.choices[0][1]
    )
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


def test_branches_on_short_ways_are_picked_and_later_others_too(monkeypatch):
    """Of branches that are all as likely."""
    monkeypatch.setattr(Outlook, "__init__", lambda self: None)
    monkeypatch.setattr(
        Outlook, "prices", lambda self, rows, a, b: np.zeros(a.shape[:2], np.float32)
    )
    own, other = Tree(np.zeros(2, np.float32)), Tree(np.array([4, 0], np.float32))
    branch(own, 0, [[0, 1], [0, 2]])
    goals = np.random.default_rng(3).uniform(-4, 4, (1, DRAWN, 2)).astype(np.float32)
    through = {}
    for number, choices in (0, CHEAPLY.choices[0][1]), (1000, CHEAPLY.choices[-1][1]):
        own_row = np.zeros(1, int)
        _, near, picked = _likely([own], [other], Outlook(), own_row, goals, number, choices)
        way = picked - own.nodes[near]
        ends = own.nodes[near] + way * np.minimum(1, 2 / np.linalg.norm(way, axis=1))[:, None]
        through[number] = own.costs[near] + np.linalg.norm(ends - own.nodes[near], axis=1)
        through[number] += np.linalg.norm(ends - other.nodes[0], axis=1)
    for schedule in (CHEAPLY, SPARINGLY):
        assert all(choices.sum() == DRAWN for _, choices in schedule.choices)
    assert len(through[0]) == 5
    assert len(through[1000]) == 62
    assert through[0].max() < 5.5  # where the straight way is 4
    assert through[1000].max() > 6
    assert through[1000].min() < 4.5


def test_what_is_not_certified_is_cut_off_and_gone_around(
    robot, strategy, tester, problems, monkeypatch
):
    before = grown(robot, strategy, tester, problems)
    i = int(np.argmax([0 if path is None else len(path) for path in before.paths]))
    barred = before.paths[i][1]

    def refusing(self, ids, paths):
        found = [~(path[1:] == barred).all(axis=1) for path in paths]
        for at, path, good in zip(ids, paths, found, strict=True):
            if good.all() and self.paths[at] is None:
                self.paths[at] = path
        return found

    monkeypatch.setattr(Progress, "certify", refusing)
    cut, gone = Tree.cut, []
    monkeypatch.setattr(Tree, "cut", lambda self, node: (gone.append(node), cut(self, node)))
    after = grown(robot, strategy, tester, jax.tree.map(lambda x: x[i : i + 1], problems))
    assert gone
    assert after.paths[0] is not None
    assert not (after.paths[0] == barred).all(axis=1).any()


def test_a_node_that_is_cut_off_takes_with_it_what_hangs_on_it():
    tree = Tree(np.zeros(1, np.float32))
    tip = branch(tree, 0, [[1], [2], [3]])
    branch(tree, 0, [[-1]])
    branch(tree, tip, [[4]])
    tree.cut(2)
    q = np.array([[4], [1.6], [-2]], np.float32)
    np.testing.assert_array_equal(tree.nearest(q), [1, 1, 4])


def test_no_time_grows_nothing(robot, strategy, tester, problems):
    progress = grown(robot, strategy, tester, problems, time_limit=-1.0)
    assert all(path is None for path in progress.paths)
    assert not progress.rounds.any()


def test_the_nearest_nodes_are_those_of_all_distances(monkeypatch):
    rng = np.random.default_rng(8)
    nodes, q = (rng.normal(size=(n, 7)).astype(np.float32) for n in (90, 12))
    tree = Tree(nodes[0])
    for node in nodes[1:]:
        branch(tree, 0, node[None])
    wanted = np.linalg.norm(nodes - q[:, None], axis=-1).argmin(axis=1)
    np.testing.assert_array_equal(tree.nearest(q), wanted)
    monkeypatch.setattr("gnnjax.planning.tree._PRODUCT", 7 * 12 * 8)  # blocks of eight nodes
    np.testing.assert_array_equal(tree.nearest(q), wanted)


def test_a_tree_has_room_for_long_branches_and_knows_its_ways():
    tree = Tree(np.zeros(2, np.float32))
    straight = np.cumsum(np.ones((300, 2), np.float32), axis=0)
    tip = branch(tree, 0, straight)
    np.testing.assert_array_equal(
        tree.nodes[tree.way(tip)[::-1]], np.stack([0 * straight[0], *straight])
    )
    two = np.array([[1, 5], [300, 301], [300, 303]], np.float32)
    side, beyond = tree.add(np.array([1, tip]), np.array([1, 2]), two).tolist()
    assert tree.way(side) == [side, 1, 0]
    assert tree.way(beyond)[:3] == [beyond, beyond - 1, tip]
    np.testing.assert_allclose(
        tree.costs[[tip, side, beyond]],
        [300 * 2**0.5, 2**0.5 + 4, 300 * 2**0.5 + 3],
        rtol=1e-5,
    )


def test_of_shortcuts_few_are_tested_and_the_shortest_way_is_that_along_all_that_hold(
    robot, tester, problems, monkeypatch
):
    rng = np.random.default_rng(4)
    pieces = [rng.uniform(-2, 2, (number, 3)).astype(np.float32) for number in (3, 4, 6)]
    holds, asked = {}, 0

    def hold(start, end):
        key = start.tobytes() + end.tobytes()
        return holds.setdefault(key, rng.random() < 0.4)

    def test(self, placed, items, num, clock):
        nonlocal asked
        asked += num
        free = np.array([hold(*ends) for ends in zip(items.starts, items.ends, strict=True)])
        return Outcome(free.astype(int), ~free, np.ones(num, int), np.ones(num, int))

    monkeypatch.setattr(SequenceTester, "__call__", test)
    found = _cut(Batch(robot, problems, Limits(), tester), np.arange(3), pieces)
    first, second = np.triu_indices(_POINTS, 1)
    assert 3 < asked < 0.8 * 3 * len(first)
    for piece, way in zip(pieces, found, strict=True):
        points, edge = _spread(piece)
        free = [
            edge[a] == edge[b - 1] or hold(points[a], points[b])
            for a, b in zip(first, second, strict=True)
        ]
        lengths = np.linalg.norm(points[second] - points[first], axis=1)
        best = _shortest(points, np.where(free, lengths, np.inf))
        assert path_length(way) == pytest.approx(path_length(best), rel=1e-5)
        assert path_length(best) < 0.999 * path_length(piece)


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
