"""Sequences of many problems, tested together, against one by one and MuJoCo's C engine."""

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.engine import Engine
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import EDGE_RESOLUTION, make_checker
from gnnjax.collision.sequences import Items, SequenceTester
from gnnjax.scene.scene import make_scene
from tests.draws import random_configurations
from tests.fine_scan import random_scene

pytestmark = pytest.mark.usefixtures("all_sizes")

NUM_SCENES = 3


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def checker(robot):
    checker = make_checker(robot)
    return checker._replace(
        check_configurations=jax.jit(checker.check_configurations),
        check_edges=jax.jit(checker.check_edges),
    )


@pytest.fixture(scope="module")
def tester(robot, checker):
    return SequenceTester(robot, checker, EDGE_RESOLUTION)


def make_scenes(rng):
    """Scenes of nine rotated boxes and padding: one with holes, one without boxes."""
    scenes = [random_scene(rng, 9) for _ in range(NUM_SCENES)]
    scenes[0].mask[[0, 3]] = False
    scenes[2].mask[:] = False
    return jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *scenes)


@pytest.fixture(scope="module")
def scenes():
    return make_scenes(np.random.default_rng(0))


def random_items(robot, rng, num, most=8, reach=0.5):
    """Items of `num` sequences of up to `most`; long and short motions, and configurations."""
    sequence = np.repeat(np.arange(num), rng.integers(0, most + 1, num))
    starts = random_configurations(rng, robot, len(sequence))
    ends = random_configurations(rng, robot, len(sequence))
    # Among them many that are shorter than the resolution, and some without any length.
    part = rng.choice([0.0, 0.005, 0.1, reach], (len(sequence), 1)).astype(np.float32)
    ends = starts + part * (ends - starts)
    owner = rng.integers(0, NUM_SCENES, num)[sequence]
    return Items(sequence, owner, starts, ends, rng.random(len(sequence)) < 0.7)


def of_sequence(items, chosen):
    """The items of some sequences, in the order of `chosen`."""
    rows = [np.flatnonzero(items.sequence == s) for s in chosen]
    number = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
    picked = Items(*(part[np.concatenate(rows)] for part in items))
    return picked._replace(sequence=number)


def one_by_one(items, num, test):
    """A plain loop: what `Outcome` holds, sequence by sequence, with a test of single items."""
    outcome = []
    for s in range(num):
        num_valid, refuted, num_checks, num_edges = 0, False, 0, 0
        for i in np.flatnonzero(items.sequence == s):
            valid, checks = test(items, i)
            num_checks += checks
            num_edges += int(items.motion[i])
            if not valid:
                refuted = True
                break
            num_valid += 1
        outcome.append((num_valid, refuted, num_checks, num_edges))
    return [np.array(column) for column in zip(*outcome, strict=True)]


def assert_same(outcome, expected):
    for ours, theirs in zip(outcome, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_sequences_are_what_the_checker_says_of_single_edges(robot, checker, tester, scenes):
    own = [jax.tree.map(lambda x, p=p: x[p], scenes) for p in range(NUM_SCENES)]

    def test(items, i):
        scene = own[items.owner[i]]
        if not items.motion[i]:
            return checker.check_configurations(scene, items.starts[i : i + 1])[0], 1
        checks = checker.check_edges(scene, items.starts[i : i + 1], items.ends[i : i + 1])
        return checks.valid[0], int(checks.num_checks[0])

    items = random_items(robot, np.random.default_rng(1), 80)
    outcome = tester(tester.place(scenes), items, 80)
    assert_same(outcome, one_by_one(items, 80, test))
    assert 15 < outcome.refuted.sum() < 65
    assert (outcome.num_edges == 0).any()


def plain_motion(engine, start, end):
    """Tests a motion configuration by configuration, halving what is left: `(valid, checks)`."""
    if tuple(start) > tuple(end):
        start, end = end, start
    intervals = int(np.ceil(np.linalg.norm(end - start) / np.float32(EDGE_RESOLUTION)))
    stretches, num_checks = deque([(0, intervals)]), 0
    while stretches:
        low, high = stretches.popleft()
        middle = (low + high) // 2
        if middle <= low:
            continue
        stretches += [(low, middle), (middle, high)]
        num_checks += 1
        q = start + np.float32(middle) / np.float32(intervals) * (end - start)
        if not engine.valid(q[None])[0]:
            return False, num_checks
    return True, num_checks


def test_sequences_are_what_mujoco_says_configuration_by_configuration(robot, tester, scenes):
    engines = [
        Engine(robot, jax.tree.map(lambda x, p=p: np.asarray(x[p]), scenes))
        for p in range(NUM_SCENES)
    ]

    def test(items, i):
        engine = engines[items.owner[i]]
        if items.motion[i]:
            return plain_motion(engine, items.starts[i], items.ends[i])
        return engine.valid(items.starts[i : i + 1])[0], 1

    # Few sequences and many: other stretches, and other blocks.
    for num, most in ((3, 12), (60, 8), (400, 3)):
        items = random_items(robot, np.random.default_rng(num), num, most, reach=0.8)
        outcome = tester(tester.place(scenes), items, num)
        assert_same(outcome, one_by_one(items, num, test))
        assert 0 < outcome.refuted.sum() < num


def test_a_sequence_comes_out_the_same_whoever_shares_the_call(robot, tester, scenes):
    rng = np.random.default_rng(2)
    items = random_items(robot, rng, 40)
    together = tester(tester.place(scenes), items, 40)
    for chosen in (rng.permutation(40), rng.permutation(40)[:7], *np.arange(40)[:, None]):
        outcome = tester(tester.place(scenes), of_sequence(items, chosen), len(chosen))
        assert_same(outcome, [part[chosen] for part in together])


def test_a_sequence_does_not_depend_on_the_direction_of_its_motions(robot, tester, scenes):
    items = random_items(robot, np.random.default_rng(3), 60)
    there = tester(tester.place(scenes), items, 60)
    motion = items.motion[:, None]
    back = items._replace(
        starts=np.where(motion, items.ends, items.starts),
        ends=np.where(motion, items.starts, items.ends),
    )
    assert_same(tester(tester.place(scenes), back, 60), there)
    # Ends of items that are no motions are not looked at.
    blind = items._replace(ends=np.where(motion, items.ends, np.float32(np.nan)))
    assert_same(tester(tester.place(scenes), blind, 60), there)


def test_motions_shorter_than_the_resolution_and_empty_sequences_hold(tester, scenes):
    # A blocked place: the arm beyond its limits, which no test of the ends would accept.
    starts = np.full((4, 3), 9.0, np.float32)
    ends = starts + np.float32([[0.0], [0.01], [0.028], [0.0288]])  # the last is 0.0499 long
    items = Items(np.array([1, 1, 3, 3]), np.zeros(4, int), starts, ends, np.ones(4, bool))
    outcome = tester(tester.place(scenes), items, 5)
    assert outcome.num_valid.tolist() == [0, 2, 0, 2, 0]
    assert outcome.num_edges.tolist() == [0, 2, 0, 2, 0]
    assert not outcome.refuted.any()
    assert not outcome.num_checks.any()
    nothing = Items(*(part[:0] for part in items))
    for num in (0, 2):
        for part in tester(tester.place(scenes), nothing, num):
            np.testing.assert_array_equal(part, np.zeros(num))


def test_a_refuted_item_after_items_that_need_no_test_is_counted_where_it_stands(tester, scenes):
    here, beyond = np.zeros(3, np.float32), np.full(3, 9, np.float32)
    starts = np.stack([here, here, beyond, here])
    items = Items(np.zeros(4, int), np.full(4, 2), starts, starts, np.array([1, 0, 0, 1], bool))
    outcome = tester(tester.place(scenes), items, 1)
    assert [int(part[0]) for part in outcome] == [2, 1, 2, 1]


@pytest.mark.parametrize(
    ("side", "is_motion", "bad"),
    [
        ("starts", True, np.nan),
        ("starts", True, np.inf),
        ("ends", True, np.nan),
        ("ends", True, 1e9),
        ("starts", False, np.nan),
        ("starts", False, 1e9),
    ],
)
def test_an_item_that_is_no_number_is_refuted_alone(robot, tester, scenes, side, is_motion, bad):
    items = random_items(robot, np.random.default_rng(4), 30)
    whole = tester(tester.place(scenes), items, 30)
    first = np.searchsorted(items.sequence, np.arange(30))
    # In the middle of a sequence that holds up to there.
    s = int(np.flatnonzero(whole.num_valid >= 4)[0])
    i = first[s] + 2
    motion, changed = items.motion.copy(), getattr(items, side).copy()
    motion[i], changed[i, 1] = is_motion, bad
    outcome = tester(tester.place(scenes), items._replace(motion=motion, **{side: changed}), 30)
    others = np.arange(30) != s
    assert_same([part[others] for part in outcome], [part[others] for part in whole])
    assert outcome.num_valid[s] == 2
    assert outcome.refuted[s]
    assert outcome.num_edges[s] == motion[first[s] : i + 1].sum()


def test_thousands_of_configurations_in_one_call(robot, checker, tester, scenes):
    num = 5000
    rng = np.random.default_rng(5)
    q = random_configurations(rng, robot, num)
    owner = rng.integers(0, NUM_SCENES, num)
    alone = np.stack(
        [
            checker.check_configurations(jax.tree.map(lambda x, p=p: x[p], scenes), q)
            for p in range(NUM_SCENES)
        ]
    )
    valid = alone[owner, np.arange(num)]
    assert 200 < (~valid).sum() < num - 200
    before = tester.computed
    items = Items(np.arange(num), owner, q, q, np.zeros(num, bool))
    outcome = tester(tester.place(scenes), items, num)
    assert_same(outcome, (valid, ~valid, np.ones(num), np.zeros(num)))
    assert num <= tester.computed - before < 1.1 * num
    # All in one sequence.
    owner = np.full(num, 2)
    q = np.concatenate([np.zeros((num - 50, 3)), np.full((50, 3), 9)]).astype(np.float32)
    items = Items(np.zeros(num, int), owner, q, q, np.zeros(num, bool))
    outcome = tester(tester.place(scenes), items, 1)
    assert [int(part[0]) for part in outcome] == [num - 50, 1, num - 49, 0]


def test_everything_is_compiled_beforehand(robot, scenes):
    checker = make_checker(robot)
    traced = []

    def check_each(*args):
        traced.append(args[2].shape)
        return checker.check_each(*args)

    tester = SequenceTester(robot, checker._replace(check_each=check_each), EDGE_RESOLUTION)
    tester.warm_up(tester.place(scenes), 3)
    assert traced == [(8, 8, 3), (32, 8, 3)]
    assert tester.computed == 0
    rng = np.random.default_rng(6)
    for num in (1, 5, 30):
        tester(tester.place(scenes), random_items(robot, rng, num, reach=0.8), num)
    assert len(traced) == 2


@pytest.mark.parametrize("backend", ["fused", "mjx"])
def test_each_in_its_own_scene_is_all_in_one_scene(robot, backend):
    checker = make_checker(robot, backend)
    check, check_each = jax.jit(checker.check_configurations), jax.jit(checker.check_each)
    rng = np.random.default_rng(7)
    scenes = make_scenes(rng)
    q = random_configurations(rng, robot, 256)
    q[:3, 1] = np.nan, np.inf, 9.0
    owner = rng.integers(0, NUM_SCENES, 256).astype(np.int32)
    found = np.asarray(check_each(checker.place(scenes), owner, q[:, None]))[:, 0]
    alone = [check(jax.tree.map(lambda x, p=p: x[p], scenes), q) for p in range(NUM_SCENES)]
    np.testing.assert_array_equal(found, np.stack(alone)[owner, np.arange(256)])
    assert not found[:3].any()
    for p in range(NUM_SCENES):
        assert 0 < found[owner == p].sum()
    assert not found[3:][owner[3:] < 2].all()


def test_unrotated_boxes_are_the_same_to_a_kernel_that_relies_on_it(robot):
    rng = np.random.default_rng(8)
    scenes = [
        make_scene(rng.uniform(-0.9, 0.9, (4, 3)), rng.uniform(0.05, 0.25, (4, 3)))
        for _ in range(NUM_SCENES)
    ]
    scenes = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *scenes)
    q = random_configurations(rng, robot, 256)
    owner = rng.integers(0, NUM_SCENES, 256).astype(np.int32)
    checkers = [make_checker(robot, axis_aligned=aligned) for aligned in (False, True)]
    found = [
        np.asarray(jax.jit(c.check_each)(c.place(scenes), owner, q[:, None])) for c in checkers
    ]
    np.testing.assert_array_equal(*found)
    assert 20 < found[0].sum() < 236
