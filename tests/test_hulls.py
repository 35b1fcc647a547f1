"""Parts as they are: what spheres leave open, against MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.engine import Engine
from gnnjax.arm.hulls import simpler_hulls
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import clearances
from gnnjax.collision.sequences import Items, SequenceTester
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.problems.problem import Problem
from gnnjax.scene.allowed import allow_contacts
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.mujoco_world import deepest_contact
from gnnjax.scene.scene import Scene, make_scene, scene_from_shapes
from gnnjax.scene.shapes import box, capsule, cylinder, half_space, sphere
from tests.arms import CRANE


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "crane.xml"
    path.write_text(CRANE)
    return load_robot(path)


def draw_scene(rng, num=6) -> Scene:
    shapes = []
    for i in range(num):
        center, quat = rng.normal(size=3), rng.normal(size=4)
        center *= rng.uniform(0.3, 0.8) / np.linalg.norm(center)
        sizes = rng.uniform(0.04, 0.15, 3)
        shapes.append(
            (
                box(center, sizes, quat),
                cylinder(center, sizes[0], sizes[1], quat),
                sphere(center, sizes[0]),
                capsule(center, sizes[0], sizes[1], quat),
                half_space([0, 0, -0.3], [0, 0, 1]),
            )[i % 5]
        )
    return scene_from_shapes(shapes)


def near_contact(rng, robot, scene, num):
    """Configurations, most of them within 10 mm of a contact: halved between free and not."""
    engine = Engine(robot, scene)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (8 * num, robot.num_dof))
    free = engine.valid(q)
    near = []
    for start, end in zip(q[free], q[~free], strict=False):
        for _ in range(int(rng.integers(3, 9))):
            middle = (start + end) / 2
            start, end = (middle, end) if engine.valid(middle[None])[0] else (start, middle)
        near += [start, end]
    return np.array(near)[: 2 * num]


def least_distance(robot, scene, q):
    """m, of what may touch what, by the C engine; negative in collision."""
    engine, found = Engine(robot, scene), np.empty(len(q))
    model, data = engine.model, engine.data
    parts = robot.part_geoms.tolist()
    moving = [g for g in parts if model.body_weldid[model.geom_bodyid[g]]]
    placed = range(model.ngeom - len(scene.mask), model.ngeom)
    pairs = [(a, b) for a in moving for b, exists in zip(placed, scene.mask, strict=True) if exists]
    pairs += [(parts[a], parts[b]) for a, b in robot.part_pairs.tolist()]
    for row, at in enumerate(q):
        data.qpos[:] = at
        mujoco.mj_kinematics(model, data)
        found[row] = min(mujoco.mj_geomDistance(model, data, *pair, 1.0, None) for pair in pairs)
    return found


def test_what_touches_is_refused_and_what_is_free_by_three_millimetres_is_not(crane):
    rng = np.random.default_rng(0)
    refused_by_spheres, num = 0, 0
    for _ in range(4):
        scene = draw_scene(rng)
        q = near_contact(rng, crane, scene, 60)
        apart = least_distance(crane, scene, q)
        found = clearances(crane, scene, q, most=0.0)
        assert not ((found > 0) & (apart < -1e-5)).any()
        # Cylinders of the arm have up to half a millimetre too much.
        assert not ((found <= 0) & (apart > 1.5e-3)).any()
        refused_by_spheres += int(((clearances(crane, scene, q) <= 0) & (apart > 1.5e-3)).sum())
        num += int((np.abs(apart) < 0.01).sum())
        for at in q[apart < -1e-4][:5]:
            assert deepest_contact(crane, scene, at).depth > 0
    assert num > 100
    assert refused_by_spheres > 20


def test_flat_tests_among_more_obstacles_than_a_word_has_bits(crane):
    rng = np.random.default_rng(2)
    scenes, drawn = [], []
    for _ in range(2):
        # Of one kind, so that they stay in order; the last ones are the only ones in reach.
        far = [box([5.0 + i, 0, 0], [0.1, 0.1, 0.1]) for i in range(34)]
        centers = rng.normal(size=(6, 3))
        centers *= rng.uniform(0.3, 0.8, (6, 1)) / np.linalg.norm(centers, axis=1, keepdims=True)
        near = [box(c, rng.uniform(0.04, 0.15, 3), rng.normal(size=4)) for c in centers]
        scenes.append(scene_from_shapes([*far, *near]))
        drawn.append(near_contact(rng, crane, scenes[-1], 60))
    tester = SequenceTester(crane, make_checker(crane), 0.05)
    placed = tester.place(stack_scenes(scenes))
    q = np.concatenate(drawn).astype(np.float32)
    owner = np.repeat([0, 1], [len(x) for x in drawn])
    # Most sequences are empty, and there are more of them than configurations in a call.
    sequence, num = 7 * np.arange(len(q)), 7 * len(q)
    outcome = tester(placed, Items(sequence, owner, q, q, np.zeros(len(q), bool)), num)
    free = ~outcome.refuted[sequence]
    found = zip(scenes, (q[owner == i] for i in (0, 1)), strict=True)
    apart = np.concatenate([least_distance(crane, *pair) for pair in found])
    assert not (free & (apart < -1e-5)).any()
    assert not (~free & (apart > 3e-3)).any()
    assert 20 < free.sum() < len(q) - 20
    # Spheres alone would have refused some of these.
    first = make_checker(crane).levels.first
    words = np.asarray(jax.jit(first)(placed.scenes, owner.astype(np.int32), q[:, None]))[:, 0]
    assert (free & (words > 0)).sum() > 5
    assert (~free & (words < 1 << 30) & (words > 0)).sum() > 5
    # A sequence ends with the first of its own that is not free.
    sequence = np.sort(rng.integers(0, 30, len(q)))
    outcome = tester(placed, Items(sequence, owner, q, q, np.zeros(len(q), bool)), 30)
    for number in range(30):
        own = free[sequence == number]
        assert outcome.refuted[number] == (not own.all())
        assert outcome.num_valid[number] == np.append(own, False).argmin()


def test_edges_that_graze_are_certified_and_none_of_them_collides(crane):
    rng, certified, by_hulls = np.random.default_rng(1), 0, 0
    for _ in range(4):
        scene = draw_scene(rng)
        q = near_contact(rng, crane, scene, 60)
        apart = least_distance(crane, scene, q)
        starts = q[apart > 1e-3]
        way = rng.normal(size=starts.shape)
        ends = starts + rng.uniform(0.01, 0.1, (len(starts), 1)) * way
        ends = np.clip(ends, crane.joint_lower, crane.joint_upper)
        holds = certify_edges(crane, scene, starts, ends)
        engine = Engine(crane, scene)
        free = np.array(
            [engine.valid(np.linspace(a, b, 60)).all() for a, b in zip(starts, ends, strict=True)]
        )
        assert not (holds & ~free).any()
        # What is free by a millimetre all along is certified.
        clear = np.array(
            [
                least_distance(crane, scene, np.linspace(a, b, 12)).min() > 2e-3 if ok else False
                for a, b, ok in zip(starts, ends, free, strict=True)
            ]
        )
        assert holds[clear].all()
        certified += int(holds.sum())
        by_hulls += int((holds & (clearances(crane, scene, starts) <= 0)).sum())
    assert certified > 100
    assert by_hulls > 20


@pytest.mark.parametrize("allow", [(), [("tip", "sphere 0"), ("jib", "box 1")]])
def test_what_configurations_prove_of_edges_is_what_testing_their_points_finds(crane, allow):
    rng, checker = np.random.default_rng(3), make_checker(crane)
    proven, tested = jax.jit(checker.edges_free), jax.jit(checker.check_edges)
    num, more = 240, 0
    for _ in range(3):
        plain = draw_scene(rng)
        scene = allow_contacts(crane, plain, allow) if allow else plain
        starts = np.resize(near_contact(rng, crane, plain, num // 2), (num, crane.num_dof))
        ends = starts + rng.uniform(0.02, 0.6, (len(starts), 1)) * rng.normal(size=starts.shape)
        ends = np.clip(ends, crane.joint_lower, crane.joint_upper)
        ends[7::60, 1], ends[9::60] = np.nan, starts[9::60]
        starts, ends = starts.astype(np.float32), ends.astype(np.float32)
        expected = np.asarray(tested(scene, starts, ends).valid)
        np.testing.assert_array_equal(proven(scene, starts, ends), expected)
        assert num // 8 < expected.sum() < 7 * num // 8
        more += (expected & (clearances(crane, plain, (starts + ends) / 2, most=0.0) < 0)).sum()
    assert more > 0 or not allow


def small_arm(folder, lift: str, radius=0.008):
    """An arm of two balls, cut from meshes, of which the second slides up and away."""
    ball = np.random.default_rng(0).normal(size=(200, 3))
    ball = radius * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    vertices = np.concatenate([ball, [[0, 0, radius], [0, 0, -radius]]]).reshape(-1)
    path = folder / "small.xml"
    path.write_text(
        f"""<mujoco model="small"><compiler angle="radian"/>
        <asset><mesh name="ball" vertex="{" ".join(f"{x:.9f}" for x in vertices)}"/></asset>
        <worldbody><body name="low"><joint name="turn" axis="1 0 0" range="-1 1"/>
          <geom type="mesh" mesh="ball"/>
          <body name="between"><joint name="lift" type="slide" axis="0 0 1" range="{lift}"/>
            <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
            <body name="high"><joint name="roll" axis="0 0 1" range="-1 1"/>
              <geom type="mesh" mesh="ball"/></body></body></body></worldbody></mujoco>"""
    )
    return load_robot(path)


def test_parts_of_a_small_arm_may_come_near_each_other(tmp_path):
    small = small_arm(tmp_path, "0.0161 0.05")
    vertices, radii = simpler_hulls(small)
    assert len(vertices[0]) < 200
    assert (radii < 0.02 * 0.0161).all()
    scene = make_scene([], [])
    q = np.zeros((2, 3), np.float32)
    q[:, 1] = 0.0164, 0.0168  # 0.4 and 0.8 mm apart
    assert (clearances(small, scene, q, most=0.0) > 0).all()
    valid = make_checker(small).check_configurations(scene, jnp.asarray(q))
    assert valid.tolist() == [False, True]


def test_parts_that_always_are_near_each_other_may_be_so(tmp_path):
    arm = small_arm(tmp_path, "0.201 0.203", radius=0.1)
    _, radii = simpler_hulls(arm)
    assert (radii <= 0.003 / 8).all()
    scene, q = make_scene([], []), np.zeros((2, 3), np.float32)
    q[:, 1] = 0.2002, 0.2015
    valid = make_checker(arm).check_configurations(scene, jnp.asarray(q))
    assert valid.tolist() == [False, True]


@pytest.mark.parametrize("gap", [0.02, 0.2])  # mm; refused at once, and by the search's tests
def test_an_end_that_is_too_near_to_a_contact_is_named_with_what_is_near(tmp_path, gap):
    small = small_arm(tmp_path, f"0.01601 {0.016 + 1.1e-3 * gap}")
    scene = scene_from_shapes([box([0.3, 0, 0], [0.1, 0.1, 0.1])])
    planner = make_planner(small, PlannerOptions())
    lift = 0.016 + 1e-3 * gap
    starts = np.array([[-0.5, lift, 0]], np.float32)
    (plan,) = planner.plan_batch(Problem(starts, -starts * [1, -1, 1], stack_scenes([scene])))
    assert plan.valid == (gap > 0.1)
    assert not plan.success
    assert f"number 0 of low and number 1 of high are {gap} mm apart" in plan.reason
    assert "at start" in plan.reason
