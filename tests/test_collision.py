"""Collision checking against MuJoCo's C engine, and edges against a plain loop."""

from collections import deque

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.kinematics import joint_terms
from gnnjax.arm.robot import load_robot
from gnnjax.collision import spheres
from gnnjax.collision.checker import EDGE_RESOLUTION, make_checker
from gnnjax.collision.edges import bisection_order
from gnnjax.collision.edges import test_edges as cut_and_test
from gnnjax.collision.exact import SIMPLER
from gnnjax.collision.fused import boxes_clear
from gnnjax.errors import InputError
from gnnjax.scene.mujoco_world import build_world, obstacles, place_boxes
from gnnjax.scene.scene import box_scene, make_scene
from tests.arms import CAPSULES
from tests.draws import random_boxes, random_configurations

MARGIN = 1e-3  # m; the C engine reports contacts this far apart, too
FEW, MANY = 5, 640  # edges at a time; each number of them is compiled


class Engine:
    """MuJoCo's C engine: one world, whose boxes move from scene to scene."""

    def __init__(self, robot, max_boxes=10, margin=MARGIN):
        self.model = build_world(robot, max_boxes)
        self.model.geom_margin[:] = margin
        self.model.body_margin[:] = margin
        self.data = mujoco.MjData(self.model)
        self.boxes = obstacles(self.model, max_boxes).geoms

    def place(self, scene):
        place_boxes(self.model, self.data, scene)

    def move(self, q):
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def gap(self, q):
        """Least contact distance, m; `MARGIN` or more without contacts."""
        self.move(q)
        mujoco.mj_collision(self.model, self.data)
        return min(self.data.contact.dist[: self.data.ncon], default=np.inf)

    def gaps(self, q):
        return np.array([self.gap(row) for row in np.asarray(q, float)])

    def box_distance(self, geom, box):
        other = int(self.boxes[box])
        return mujoco.mj_geomDistance(self.model, self.data, geom, other, 10.0, None)

    def clearance(self, robot, scene, q):
        """Least true distance, pair by pair, m."""
        self.move(np.asarray(q, float))
        weld = self.model.body_weldid[self.model.geom_bodyid]
        moving = [g for g in robot.geom_ids.tolist() if weld[g]]
        found = [self.box_distance(g, i) for g in moving for i in np.flatnonzero(scene.mask)]
        for i, j in robot.geom_ids[robot.self_pairs].tolist():
            found.append(mujoco.mj_geomDistance(self.model, self.data, i, j, 10.0, None))
        return min(found)


@pytest.fixture(scope="module")
def tiny_checker(tiny):
    return make_checker(tiny)


@pytest.fixture(scope="module")
def tiny_edges(tiny_checker):
    return jax.jit(tiny_checker.check_edges)


@pytest.fixture(scope="module")
def capsules(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "capsules.xml"
    path.write_text(CAPSULES)
    return load_robot(path)


def assert_verdicts_agree(valid, gaps, strict=0.0):
    """A checker may be so strict as to refuse what is nearer than that, in m, to contact."""
    wrong = (np.asarray(valid) != (gaps > 0)) & ((gaps < -1e-4) | (gaps > strict + 1e-4))
    assert not wrong.any(), f"{wrong.sum()} disagree, C distances {gaps[wrong][:5]}"


@pytest.fixture
def in_tables(monkeypatch):
    """As of arms with many spheres: several passes, and tables of pairs with some in a row."""
    for name, value in {"_MOST_IN_CODE": 0, "_PAIRS_A_ROW": 16, "_SPHERES_A_PASS": 16}.items():
        monkeypatch.setattr(spheres, name, value)


def test_tables_say_what_straight_line_code_does(capsules, request):
    rng = np.random.default_rng(5)
    scene = random_boxes(rng, 3, rotated=True)
    q = random_configurations(rng, capsules, 600)
    q[5, 1] = np.nan
    found = []
    for _ in range(2):
        checker = make_checker(capsules)
        assert checker.levels is not None
        clear = checker.levels.second.clear_of_itself
        found.append(
            (
                jax.jit(checker.check_configurations)(scene, q),
                jax.jit(checker.clearance)(scene, q),
                jax.jit(checker.clearance)(random_boxes(rng, 0), q),  # to itself alone
                jax.jit(clear)(q[:64], np.arange(64) % 3 > 0),
            )
        )
        request.getfixturevalue("in_tables")
    for code, tables in zip(*found, strict=True):
        same = np.asarray(tables, float), np.asarray(code, float)
        np.testing.assert_allclose(*same, atol=1e-6)
    assert 0 < found[0][0].mean() < 1


def test_the_clearance_of_small_balls_far_from_each_other_is_that_by_tables_too(tmp_path, request):
    link = '<body pos="0 0 {}"><joint axis="{}" range="-3 3"/><geom size="0.06" pos="0 0 0.5"/>'
    links = [link.format(*x) for x in ((0, "0 1 0"), (0.5, "1 0 0"), (0.5, "0 1 0"))]
    path = tmp_path / "balls.xml"
    path.write_text(
        '<mujoco><compiler angle="radian"/><worldbody><geom size="0.03" pos="0 0 0.1"/>'
        f"{''.join(links)}{'</body>' * 3}</worldbody></mujoco>"
    )
    balls, rng, found = load_robot(path), np.random.default_rng(7), []
    q = random_configurations(rng, balls, 400)
    for _ in range(2):
        checker = make_checker(balls)
        tests = checker.clearance, checker.check_configurations
        found.append([np.asarray(jax.jit(test)(random_boxes(rng, 0), q), float) for test in tests])
        request.getfixturevalue("in_tables")
    for code, tables in zip(*found, strict=True):
        np.testing.assert_allclose(tables, code, atol=1e-6)
    assert (found[0][0] > 0.3).any()
    assert (found[0][1] == 0).any()


def test_a_row_is_of_two_links_and_its_balls_hold_its_spheres(capsules, in_tables):
    table = spheres.pair_table(capsules)
    assert {frozenset(x) for x in table.pairs.reshape(-1, 2).tolist()} == {
        frozenset(x) for x in capsules.self_pairs.tolist()
    }
    for q in random_configurations(np.random.default_rng(6), capsules, 20):
        centers = np.array(
            spheres.sphere_centers(capsules, joint_terms(capsules, jnp.asarray(q, jnp.float32)))
        )
        far, apart = (
            np.linalg.norm(centers[x[..., 0]] - centers[x[..., 1]], axis=-1)
            for x in (table.near, table.pairs)
        )
        gaps = (apart - capsules.geom_radii[table.pairs].sum(axis=-1)).min(axis=1)
        assert (gaps >= far - table.reach - 1e-6).all()


@pytest.mark.parametrize(
    ("name", "rotated"), [("kinova_gen3", True), ("kuka_iiwa14", False), ("franka_panda", False)]
)
def test_shipped_arms_match_c_engine(name, rotated):
    assert_matches_c_engine(name, rotated)


def test_shipped_arms_match_c_engine_by_tables(in_tables):
    assert_matches_c_engine("franka_panda", False)


def assert_matches_c_engine(name, rotated):
    robot, rng = load_robot(name), np.random.default_rng(0)
    check = jax.jit(make_checker(robot, axis_aligned=not rotated).check_configurations)
    strict = 2 * SIMPLER  # of two parts
    engine = Engine(robot, margin=strict + MARGIN)
    num_valid, by_itself = 0, 0
    for num_boxes in (0, 2, 5, 9):
        scene = random_boxes(rng, num_boxes, rotated=rotated)
        q = random_configurations(rng, robot, 1200)
        valid = check(scene, q)
        engine.place(scene)
        gaps = engine.gaps(q)
        assert_verdicts_agree(valid, gaps, strict)
        num_valid += int(valid.sum())
        by_itself += int((gaps < 0).sum()) if num_boxes == 0 else 0
    # Both outcomes, and self-collisions, must have been there to agree on.
    assert 480 < num_valid < 4320
    assert by_itself > 2


@pytest.fixture(scope="module")
def check_capsules(capsules):
    return jax.jit(make_checker(capsules).check_configurations)


def test_capsules_match_c_engine(capsules, check_capsules):
    rng = np.random.default_rng(1)
    engine = Engine(capsules)
    # Four boxes a pass here, so that the last pass over nine holds padding.
    for num_boxes in (0, 4, 9):
        scene = random_boxes(rng, num_boxes, rotated=True, reach=1.4)
        q = random_configurations(rng, capsules, 1000)
        engine.place(scene)
        valid = check_capsules(scene, q)
        assert_verdicts_agree(valid, engine.gaps(q))
        assert 10 < valid.sum() < 990


def test_clearance_is_the_distance(capsules, tiny):
    rng = np.random.default_rng(2)
    for robot, reach in ((capsules, 0.9), (tiny, 1.5)):
        clearance = jax.jit(make_checker(robot).clearance)
        engine = Engine(robot)
        num_clear = 0
        for num_boxes in (0, 1, 3):
            scene = random_boxes(rng, num_boxes, rotated=True, reach=reach)
            q = random_configurations(rng, robot, 40)
            engine.place(scene)
            expected = np.array([engine.clearance(robot, scene, row) for row in q])
            found = np.asarray(clearance(scene, q))
            clear = expected > 0
            num_clear += clear.sum()
            # Capsules are chains of spheres here, which stand out by an eighth of their radius.
            thick = 1e-4 if robot is tiny else 0.125 * 0.06 * 2
            assert (found[clear] <= expected[clear] + 1e-4).all()
            assert (found[clear] >= expected[clear] - thick).all()
            assert (found[~clear] < 1e-4).all()
        assert num_clear > 50


def test_a_resolution_whose_table_of_points_would_overflow_is_refused(tiny):
    with pytest.raises(InputError, match=r"resolution is 0.0003, .* choose a larger one"):
        make_checker(tiny, resolution=3e-4)


def test_the_clearance_has_the_shape_of_its_configurations(tiny, tiny_checker):
    scene = random_boxes(np.random.default_rng(3), 3, rotated=True)
    q = random_configurations(np.random.default_rng(3), tiny, 6)
    clearance = jax.jit(tiny_checker.clearance)
    two, each = clearance(scene, q.reshape(2, 3, -1)), [clearance(scene, row) for row in q]
    assert two.shape == (2, 3)
    assert each[0].shape == ()
    np.testing.assert_allclose(two.ravel(), each, atol=1e-6)


def test_moved_box_is_hit(tiny):
    # The C engine keeps bounding volumes; boxes that moved or grew after compilation must not
    # leave theirs behind.
    engine = Engine(tiny)
    q = np.zeros(3)
    for center, size, hit in [
        ([0.5, 0, 0], 0.05, True),
        ([0.5, 0, 3], 0.05, False),
        ([0.5, 0, 3], 2.98, True),
        ([0.5, 0, 3], 2.5, False),
        ([-0.6, 0, 0], 0.05, False),
        ([0.55, 0.05, 0], 0.02, True),
    ]:
        engine.place(make_scene([center], [[size] * 3]))
        assert (engine.gap(q) < 0) == hit
    engine.place(make_scene([], []))
    assert engine.gap(q) > 0


def test_boxes_ignore_each_other_and_the_base(tiny):
    engine = Engine(tiny)
    engine.place(make_scene([[0, 0, -0.54], [0, 0, -0.44]], [[0.45] * 3, [0.35] * 3]))
    contacts = engine.gap(np.array([0.0, -1.0, 0.0]))
    assert contacts > 0


def plain_check_edge(engine, robot, start, end):
    """Tests an edge point by point: `(valid, number of points tested)`."""
    start, end = (np.asarray(x, np.float32) for x in (start, end))
    if tuple(start) > tuple(end):
        start, end = end, start
    length = np.linalg.norm(end - start)
    intervals = max(1, int(np.ceil(length / np.float32(EDGE_RESOLUTION))))
    num_checks = 0
    stretches = deque([(0, intervals)])
    while stretches:
        low, high = stretches.popleft()
        middle = (low + high) // 2
        if middle == low:
            continue
        stretches += [(low, middle), (middle, high)]
        num_checks += 1
        q = start + np.float32(middle) / np.float32(intervals) * (end - start)
        if engine.gap(q) <= 0:
            return False, num_checks
    return True, num_checks


def test_edges_match_plain_loop(tiny, tiny_edges):
    rng = np.random.default_rng(5)
    scene = random_boxes(rng, 2, rotated=True)
    engine = Engine(tiny)
    engine.place(scene)
    starts, ends = (random_configurations(rng, tiny, 200) for _ in range(2))
    # Long and short edges.
    ends = starts + (ends - starts) * np.linspace(0.02, 1, 200, dtype=np.float32)[:, None]
    expected = [plain_check_edge(engine, tiny, s, e) for s, e in zip(starts, ends, strict=True)]
    valid, num_checks = (np.array(column) for column in zip(*expected, strict=True))
    assert 20 < valid.sum() < 180
    for there, back in ((starts, ends), (ends, starts)):
        checks = tiny_edges(scene, *(np.resize(x, (MANY, 3)) for x in (there, back)))
        np.testing.assert_array_equal(checks.valid, np.resize(valid, MANY))
        np.testing.assert_array_equal(checks.num_checks, np.resize(num_checks, MANY))
    # Few edges are tested in other blocks than many.
    few = tiny_edges(scene, starts[-FEW:], ends[-FEW:])
    np.testing.assert_array_equal(few.valid, valid[-FEW:])
    np.testing.assert_array_equal(few.num_checks, num_checks[-FEW:])


def test_many_edges_come_to_what_few_come_to(tiny, tiny_checker, tiny_edges):
    """More than wait in the queue at a time, of all lengths, some of which cannot be tested."""
    rng = np.random.default_rng(8)
    scenes = [random_boxes(rng, num, rotated=True) for num in (0, 2)]
    starts, ends = np.array([random_configurations(rng, tiny, MANY) for _ in range(2)])
    ends = starts + (ends - starts) * rng.random((MANY, 1), np.float32) ** 2
    ends[::50] = starts[::50]
    ends[7::100, 1], ends[9::100, 0] = np.nan, 100.0
    at_once = jax.jit(jax.vmap(tiny_checker.check_edges, in_axes=(0, None, None)))(
        jax.tree.map(lambda *x: np.stack(x), *scenes), starts, ends
    )
    for number, scene in enumerate(scenes):
        parts = [
            tiny_edges(scene, starts[first : first + 64], ends[first : first + 64])
            for first in range(0, MANY, 64)
        ]
        few = jax.tree.map(lambda *x: np.concatenate(x), *parts)
        many = tiny_edges(scene, starts, ends)
        for found in (many, jax.tree.map(lambda x, i=number: x[i], at_once)):
            np.testing.assert_array_equal(found.valid, few.valid)
            np.testing.assert_array_equal(found.num_checks, few.num_checks)
        assert MANY // 4 < few.valid.sum() < MANY - MANY // 50
        assert not few.valid[7::100].any()
        assert not few.valid[9::100].any()


def test_what_configurations_prove_of_others_is_what_testing_these_finds(capsules, check_capsules):
    """Of edges of all lengths, some of which cannot be tested, of an arm that also meets itself."""
    rng, proven = np.random.default_rng(9), jax.jit(make_checker(capsules).edges_free)
    for num_boxes, reach in ((0, 1.4), (4, 0.9), (9, 1.4)):
        scene = random_boxes(rng, num_boxes, reach=reach)
        starts, ends = (random_configurations(rng, capsules, MANY) for _ in range(2))
        ends = starts + (ends - starts) * rng.random((MANY, 1), np.float32) ** 2
        # Where one joint moves alone, the bounds on motions are tight.
        ends[::2, 1:] = starts[::2, 1:]
        ends[::50] = starts[::50]
        ends[7::100, 1], ends[9::100, 0] = np.nan, 100.0
        starts[11::100, 2] = 2.65  # beyond the limit
        expected = np.zeros(MANY, bool)
        length = np.linalg.norm(ends - starts, axis=1)
        testable = np.flatnonzero(length < 20.0)
        intervals = np.maximum(np.ceil(length[testable] / np.float32(EDGE_RESOLUTION)), 1).astype(
            int
        )
        edge = np.repeat(testable, intervals - 1)
        point = np.concatenate([np.arange(1, n, dtype=np.float32) for n in intervals])
        share = (point / np.repeat(intervals, intervals - 1).astype(np.float32))[:, None]
        q = starts[edge] + share * (ends - starts)[edge]
        q = np.pad(q, ((0, -len(q) % 1000), (0, 0))).reshape(-1, 1000, q.shape[1])
        free = np.concatenate([check_capsules(scene, some) for some in q])[: len(edge)]
        expected[testable] = True
        expected[edge[~free]] = False
        np.testing.assert_array_equal(proven(scene, starts, ends), expected)
        assert MANY // 16 < expected.sum() < MANY - MANY // 25


def test_edges_leave_no_gap_wider_than_the_resolution():
    # An obstacle a bit wider than the resolution, anywhere on the edge, must be found, and a free
    # edge must take no more tests than that needs.
    order = bisection_order(80)

    def check(scene, q):
        return jnp.abs(q[:, 0] - scene.centers[0, 0]) > EDGE_RESOLUTION / 2 + 1e-5

    def edge(target, length):
        scene = box_scene(
            jnp.full((1, 3), target), jnp.ones((1, 3)), jnp.ones((1, 4)), jnp.ones(1, bool)
        )
        start, end = jnp.zeros((1, 1)), jnp.full((1, 1), length)
        return cut_and_test(check, order, EDGE_RESOLUTION, scene, start, end)

    lengths = np.random.default_rng(6).uniform(0.06, 3.9, 40).astype(np.float32)
    lengths = np.repeat(lengths, 50)
    inside = np.tile(np.linspace(0, 1, 50, dtype=np.float32), 40)
    targets = EDGE_RESOLUTION / 2 + inside * (lengths - EDGE_RESOLUTION)
    checks = jax.jit(jax.vmap(edge))(targets.astype(np.float32), lengths)
    assert not checks.valid.any()
    free = jax.jit(jax.vmap(edge))(np.full_like(lengths, 100), lengths)
    assert free.valid.all()
    np.testing.assert_array_equal(
        free.num_checks[:, 0], np.ceil(lengths / np.float32(EDGE_RESOLUTION)) - 1
    )


def test_edges_of_no_length_are_valid_and_those_beyond_range_are_not(tiny, tiny_edges):
    scene = jax.tree.map(jnp.asarray, make_scene([], []))
    q, bad = np.zeros((2, FEW, 3), np.float32)
    bad[::2, 1], bad[1::2, 0] = np.nan, 100.0
    checks = tiny_edges(scene, q, q)
    assert checks.valid.all()
    assert not checks.num_checks.any()
    checks = tiny_edges(scene, q, bad)
    assert not checks.valid.any()


def test_edges_are_tested_alike_eagerly_compiled_and_mapped(tiny, tiny_checker, tiny_edges):
    rng = np.random.default_rng(7)
    scenes = [random_boxes(rng, num, rotated=True, reach=0.7) for num in (0, 4, 8)]
    starts, ends = (random_configurations(rng, tiny, FEW) for _ in range(2))
    eager = tiny_checker.check_edges(scenes[1], jnp.asarray(starts), jnp.asarray(ends))
    jitted = [tiny_edges(scene, starts, ends) for scene in scenes]
    stacked = jax.tree.map(lambda *x: np.stack(x), *scenes)
    mapped = jax.jit(jax.vmap(tiny_checker.check_edges, in_axes=(0, None, None)))(
        stacked, starts, ends
    )
    for field in range(2):
        np.testing.assert_array_equal(eager[field], jitted[1][field])
        for s in range(3):
            np.testing.assert_array_equal(mapped[field][s], jitted[s][field])
    assert 0 < mapped.valid.sum() < mapped.valid.size


@pytest.mark.parametrize("backend", ["fused", "mjx"])
def test_configurations_beyond_limits_or_without_numbers_are_invalid(tiny, backend):
    check = jax.jit(make_checker(tiny, backend).check_configurations)
    scene = jax.tree.map(jnp.asarray, make_scene([], []))
    q = np.zeros((6, 3), np.float32)
    q[1, 2], q[2], q[3, 0] = np.nan, np.nan, np.inf
    q[4, 0] = np.nextafter(np.float32(tiny.joint_upper[0]), np.float32(9))
    q[5, 2] = np.nextafter(np.float32(tiny.joint_lower[2]), np.float32(-9))
    assert np.asarray(check(scene, q)).tolist() == [True, False, False, False, False, False]


def test_boxes_clear_matches_distances(capsules, tiny):
    rng = np.random.default_rng(8)
    for robot in (capsules, tiny):
        engine = Engine(robot)
        weld = engine.model.body_weldid[engine.model.geom_bodyid]
        for base_only in (False, True):
            found = jax.jit(lambda s, q, b=base_only, r=robot: boxes_clear(r, s, q, base_only=b))
            for _ in range(4):
                scene = random_boxes(rng, 8, rotated=True, reach=0.5)
                q = random_configurations(rng, robot, 1)[0]
                engine.place(scene)
                engine.move(np.asarray(q, float))
                geoms = [g for g in robot.geom_ids.tolist() if not (base_only and weld[g])]
                expected = [min(engine.box_distance(g, i) for g in geoms) > 0 for i in range(8)]
                assert np.asarray(found(scene, q)).tolist() == [*expected, True, True]


def test_the_spheres_around_other_geoms_notice_all_that_these_touch(tiny, tmp_path):
    path = tmp_path / "cylinder.xml"
    geom = '<geom type="sphere" size="0.07" pos="0.15 0 0.02" mass="1"/>'
    text = tiny.path.read_text()
    assert geom in text
    path.write_text(text.replace(geom, '<geom type="cylinder" size="0.1 0.1" euler="1 2 0"/>'))
    robot, rng = load_robot(path), np.random.default_rng(5)
    assert (robot.geom_parts == 3).sum() > 1
    engine, check = Engine(robot), jax.jit(make_checker(robot).check_configurations)
    scene, q = random_boxes(rng, 5, rotated=True), random_configurations(rng, robot, 500)
    engine.place(scene)
    free = np.asarray(check(scene, q))
    truth = []
    for row in q:
        engine.move(np.asarray(row, float))
        truth.append(min(engine.box_distance(3, i) for i in range(5)))
    assert (np.array(truth)[free] > 0).all()
    assert 50 < free.sum() < 480


def test_the_order_of_tests_halves_what_is_left():
    order = bisection_order(70)
    assert order.shape == (71, 70)
    for n, row in enumerate(order):
        inner = max(n - 1, 0)
        assert sorted(row[:inner]) == list(range(1, n))
        assert not row[inner:].any()
    assert order[8, :7].tolist() == [4, 2, 6, 1, 3, 5, 7]
    # After 2^k - 1 tests no stretch longer than n / 2^k, rounded up, is left.
    for n in (17, 40, 64):
        for k in range(1, 5):
            tested = np.sort(np.concatenate([[0, n], order[n, : 2**k - 1]]))
            assert np.diff(tested).max() <= -(-n // 2**k)
