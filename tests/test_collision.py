"""Collision checking against MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.arm.hulls import SIMPLER
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import EDGE_RESOLUTION, make_checker
from gnnjax.collision.fused import obstacles_clear
from gnnjax.errors import InputError
from gnnjax.scene.scene import make_scene
from tests.c_engine import MARGIN, Engine
from tests.draws import random_boxes, random_configurations

MANY = 640  # edges at a time; each number of them is compiled


def assert_verdicts_agree(valid, gaps, strict=0.0):
    """A checker may be so strict as to refuse what is nearer than that, in m, to contact."""
    wrong = (np.asarray(valid) != (gaps > 0)) & ((gaps < -1e-4) | (gaps > strict + 1e-4))
    assert not wrong.any(), f"{wrong.sum()} disagree, C distances {gaps[wrong][:5]}"


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


def test_the_clearance_has_the_shape_of_its_configurations(tiny):
    scene = random_boxes(np.random.default_rng(3), 3, rotated=True)
    q = random_configurations(np.random.default_rng(3), tiny, 6)
    clearance = jax.jit(make_checker(tiny).clearance)
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


@pytest.mark.parametrize("backend", ["fused", "mjx"])
def test_configurations_beyond_limits_or_without_numbers_are_invalid(tiny, backend):
    check = jax.jit(make_checker(tiny, backend).check_configurations)
    scene = jax.tree.map(jnp.asarray, make_scene([], []))
    q = np.zeros((6, 3), np.float32)
    q[1, 2], q[2], q[3, 0] = np.nan, np.nan, np.inf
    q[4, 0] = np.nextafter(np.float32(tiny.joint_upper[0]), np.float32(9))
    q[5, 2] = np.nextafter(np.float32(tiny.joint_lower[2]), np.float32(-9))
    assert np.asarray(check(scene, q)).tolist() == [True, False, False, False, False, False]


def test_obstacles_clear_matches_distances(capsules, tiny):
    rng = np.random.default_rng(8)
    for robot in (capsules, tiny):
        engine = Engine(robot)
        weld = engine.model.body_weldid[engine.model.geom_bodyid]
        for base_only in (False, True):
            found = jax.jit(
                lambda s, q, b=base_only, r=robot: obstacles_clear(r, s, q, base_only=b)
            )
            for _ in range(4):
                scene = random_boxes(rng, 8, rotated=True, reach=0.5)
                q = random_configurations(rng, robot, 1)[0]
                engine.place(scene)
                engine.move(np.asarray(q, float))
                geoms = [g for g in robot.sphere_geoms.tolist() if not (base_only and weld[g])]
                expected = [min(engine.box_distance(g, i) for g in geoms) > 0 for i in range(8)]
                assert np.asarray(found(scene, q)).tolist() == [*expected, True, True]


def test_the_spheres_around_other_geoms_notice_all_that_these_touch(tiny, tmp_path):
    path = tmp_path / "cylinder.xml"
    geom = '<geom type="sphere" size="0.07" pos="0.15 0 0.02" mass="1"/>'
    text = tiny.path.read_text()
    assert geom in text
    path.write_text(text.replace(geom, '<geom type="cylinder" size="0.1 0.1" euler="1 2 0"/>'))
    robot, rng = load_robot(path), np.random.default_rng(5)
    assert (robot.sphere_parts == 3).sum() > 1
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
