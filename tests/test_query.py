"""What is wrong with queries, one by one and many at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.clearances import base_clear
from gnnjax.collision.fused import obstacles_clear
from gnnjax.errors import InputError
from gnnjax.planning.query import check_queries, check_query
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import box_scene, make_scene, scene_from_shapes
from gnnjax.scene.shapes import box, half_space
from tests.fine_scan import random_scene


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


def stack(scenes):
    return jax.tree.map(lambda *x: np.stack(x), *scenes)


def queries(robot):
    """Good queries and one of each fault, and what the faults are."""
    free, away = make_scene([[0.6, 0, 0]], [[0.1] * 3]), [2.0, 0.0, 0.0]
    base = make_scene([[2.0, 0, 0], [0, 0, 0.15]], [[0.1] * 3] * 2)
    nan, flat, long = (
        free._replace(**{name: getattr(free, name) * factor})
        for name, factor in (("centers", np.nan), ("half_extents", 0), ("quats", 2))
    )
    rows = [
        (free, away, [-2.0, 0, 0], None),
        (nan, away, away, "existing obstacle 0 of the scene has centers"),
        (free, [0.0, 0, 0], away, "start .* is in collision"),
        (free, away, [0.0, 0, 0], "goal .* is in collision"),
        (flat, away, away, "existing obstacle 0 of the scene has half_extents"),
        (free, [1e300, 0, 0], away, "start has inf for joint a"),
        (free, away, [0.0, np.nan, 0], "goal has nan for joint b; it must lie between"),
        (free, away, away, None),
        (base, away, away, "box 1 of the scene reaches .* mm into the base of tiny"),
        (long, away, away, "existing obstacle 0 of the scene has quats"),
        (base, [9.0, 0, 0], away, "box 1 of the scene reaches .* mm into the base of tiny"),
        (nan._replace(mask=free.mask & False), away, away, None),
    ]
    scenes, starts, goals, faults = zip(*rows, strict=True)
    return Problem(np.array(starts), np.array(goals), stack(scenes)), faults


def test_each_query_of_a_batch_gets_its_own_reason(robot):
    problems, faults = queries(robot)
    reasons = check_queries(robot, problems)
    for i, (reason, fault) in enumerate(zip(reasons, faults, strict=True)):
        start, goal, scene = jax.tree.map(lambda x, i=i: x[i], problems)
        if fault is None:
            assert reason is None
            assert check_query(robot, scene, start, goal)[0].dtype == np.float32
            continue
        with pytest.raises(InputError, match=fault) as found:
            check_query(robot, scene, start, goal)
        assert str(found.value) == reason
    order = np.random.default_rng(0).permutation(len(reasons))
    again = check_queries(robot, jax.tree.map(lambda x: x[order], problems))
    assert again == [reasons[i] for i in order]


def test_no_queries_have_no_reasons(robot):
    assert check_queries(robot, jax.tree.map(lambda x: x[:0], queries(robot)[0])) == []


def test_arrays_that_are_no_queries_are_refused(robot):
    problems, _ = queries(robot)
    for bad in (
        problems._replace(start=problems.start[:, :2]),
        problems._replace(goal=problems.goal[:3]),
        jax.tree.map(lambda x: x[0], problems),
    ):
        with pytest.raises(InputError, match=r"starts have shape .*; tiny needs \[P, 3\] twice"):
            check_queries(robot, bad)


@pytest.mark.parametrize("name", ["tiny", "kuka_iiwa14"])
def test_boxes_touch_the_base_where_the_kernels_say_so(robot, name):
    robot, rng = robot if name == "tiny" else load_robot(name), np.random.default_rng(3)
    scenes = stack([random_scene(rng, num=num % 10) for num in range(100)])
    centers = rng.uniform(-0.3, 0.3, scenes.centers.shape).astype(np.float32)
    mask = rng.random(scenes.mask.shape) < 0.7
    scenes = box_scene(centers, scenes.half_extents, scenes.quats, mask)
    found = base_clear(robot, scenes)
    one = jax.tree.map(lambda x: x[7], scenes)
    np.testing.assert_array_equal(base_clear(robot, one), found[7])
    kernel = jax.vmap(lambda s: obstacles_clear(robot, s, jnp.asarray(robot.home), base_only=True))
    np.testing.assert_array_equal(found, kernel(scenes))
    assert 50 < (~found).sum() < 950


@pytest.mark.parametrize("name", ["kuka_iiwa14", "kinova_gen3", "franka_panda"])
def test_arms_may_stand_on_a_floor_and_not_in_one(name):
    robot = load_robot(name)
    floor = half_space([0, 0, 0], [0, 0, 1])
    q = robot.home
    assert check_query(robot, scene_from_shapes([floor]), q, q)
    beside = box([0.3, 0, 0.02], [0.05, 0.05, 0.02])
    deep = half_space([0, 0, 0.03], [0, 0, 1])
    around = box([0, 0, 0.05], [0.3, 0.3, 0.01])
    assert check_query(robot, scene_from_shapes([floor, beside]), q, q)
    for shapes, named in (([deep], "half_space 0"), ([floor, around], "box 0")):
        with pytest.raises(InputError, match=rf"{named} of the scene reaches \d+ mm into the base"):
            check_query(robot, scene_from_shapes(shapes), q, q)


def test_what_collides_is_named_and_degrees_are_asked_about():
    robot = load_robot("kuka_iiwa14")
    scene = make_scene([[0.0, 0.0, 1.1]], [[0.1] * 3])
    q = np.zeros(7)
    with pytest.raises(
        InputError, match=r"start .* in collision: link_\d and box 0 overlap by .* mm"
    ):
        check_query(robot, scene, q, q)
    with pytest.raises(
        InputError, match=r"90 for joint joint_4; .* \(radians; are these degrees\?"
    ):
        check_query(robot, make_scene([], []), [0, 0, 0, 90, 0, 0, 0], q)
