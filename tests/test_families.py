"""Families: scenes that are what they say, and problems that are valid and reproducible."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tyro
from scipy.spatial.transform import Rotation

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import configuration_clearance
from gnnjax.collision.checker import make_checker
from gnnjax.collision.fused import boxes_clear
from gnnjax.errors import InputError
from gnnjax.generate import GenerateConfig, generate
from gnnjax.problems import family_problem, labelled
from gnnjax.problems.families import FAMILIES
from gnnjax.problems.family_problem import arm_reach, sample_family_problem
from gnnjax.problems.labelled import problem_keys
from gnnjax.problems.shards import load_problems, read_manifest
from gnnjax.scene.scene import BOX_BUCKETS, is_axis_aligned

NUM_BOXES = {
    "shelf": (6, 8),
    "table": (5, 10),
    "window": (4, 4),
    "clutter": (10, 20),
    "bin": (5, 5),
}


@functools.cache
def many_scenes(family):
    keys = jax.random.split(jax.random.key(0), 200)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(FAMILIES[family]))(keys))


@functools.cache
def sampler(path, family):
    """A robot, and the function that draws a problem of a family for it."""
    robot = load_robot(path)
    check = make_checker(robot).check_configurations
    clear = functools.partial(boxes_clear, robot, q=jnp.zeros(3), base_only=True)
    draw = functools.partial(
        sample_family_problem,
        family=family,
        robot=robot,
        check_configurations=check,
        boxes_clear=clear,
    )
    return robot, draw, jax.jit(draw)


def tip_by_mujoco(robot, q):
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    return data.geom_xpos[robot.geom_ids[-1]]  # the tiny arm's last body has one geom


def inside(region, point):
    rotation = Rotation.from_quat(region.quat, scalar_first=True)
    return np.abs(rotation.inv().apply(point - region.center)) <= region.half_extents + 1e-5


@pytest.mark.parametrize("family", FAMILIES)
def test_scenes_fill_a_bucket_with_turned_boxes_of_positive_size(family):
    drawn = many_scenes(family)
    scene = drawn.scene
    assert scene.mask.shape[1] in BOX_BUCKETS
    counts = scene.mask.sum(axis=1)
    assert (counts.min(), counts.max()) == NUM_BOXES[family]
    assert (scene.half_extents > 0).all()
    np.testing.assert_allclose(np.linalg.norm(scene.quats, axis=-1), 1, atol=1e-5)
    assert not is_axis_aligned(scene)
    for region in (drawn.start, drawn.goal):
        assert (region.half_extents > 0).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_problems_are_valid_and_the_tip_is_where_it_should_be(tiny_path, family):
    robot, _, draw = sampler(tiny_path, family)
    for key in jax.random.split(jax.random.key(0), 3):
        drawn = draw(key)
        problem, first, last, found = jax.tree.map(np.asarray, drawn)
        assert found
        assert not np.array_equal(problem.start, problem.goal)
        for q, region in ((problem.start, first), (problem.goal, last)):
            assert configuration_clearance(robot, problem.scene, q) > 0
            assert ((q >= robot.joint_lower) & (q <= robot.joint_upper)).all()
            assert inside(region, tip_by_mujoco(robot, q)).all()
        for one, again in zip(jax.tree.leaves(drawn), jax.tree.leaves(draw(key)), strict=True):
            np.testing.assert_array_equal(one, again)


def test_a_batch_equals_single_draws(tiny_path):
    _, draw, single = sampler(tiny_path, "window")
    keys = jax.random.split(jax.random.key(0), 3)
    batch = jax.jit(jax.vmap(draw))(keys)
    for many, one in zip(jax.tree.leaves(batch), jax.tree.leaves(single(keys[1])), strict=True):
        np.testing.assert_allclose(many[1], one, atol=1e-5)


def test_only_the_window_leads_through_its_wall():
    drawn = many_scenes("window")
    for i in range(20):
        centers, half_extents = drawn.scene.centers[i, :4], drawn.scene.half_extents[i, :4]
        turn = Rotation.from_quat(drawn.scene.quats[i, 0], scalar_first=True)
        sides = turn.inv().apply(centers)
        lower, upper = (sides + s * half_extents for s in (-1, 1))
        # The four parts and the window make up the whole rectangle.
        width, height = upper[1, 1] - lower[0, 1], upper[0, 2] - lower[0, 2]
        hole = (lower[1, 1] - upper[0, 1]) * (lower[3, 2] - upper[2, 2])
        area = np.prod(2 * half_extents[:, 1:], axis=1).sum()
        np.testing.assert_allclose(area + hole, width * height, rtol=1e-4)
        assert 0.3**2 < hole < 0.6**2


@pytest.mark.parametrize("name", ["kuka_iiwa14", "kinova_gen3", "franka_panda"])
def test_the_reach_of_shipped_arms_is_a_ball_above_the_base(name):
    reach = arm_reach(load_robot(name))
    np.testing.assert_allclose(reach.center[:2], 0, atol=0.05)
    assert 0.3 < reach.center[2] < 0.7
    assert 0.7 < reach.radius < 1.1


def test_keys_of_families_splits_and_seeds_are_apart(tiny_path):
    sets = [(0, s, f) for s in ("train", "validation", "test") for f in ("paper", *FAMILIES)]
    sets += [(1, "test", "bin")]
    keys = [jax.random.key_data(problem_keys(a, b, 0, 5, c)).tolist() for a, b, c in sets]
    assert len({tuple(key) for part in keys for key in part}) == 5 * len(sets)
    # The seeds that the paper's problems have always had.
    paper = jax.random.fold_in(jax.random.fold_in(jax.random.key(3), 2), 7)
    assert paper == problem_keys(3, "test", 7, 1)[0]


def test_a_training_set_of_a_family_has_roadmaps_and_names_it(tiny_path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = generate(
        GenerateConfig(
            robot=str(tiny_path), family="table", num_problems=2, num_nodes=24, shard_size=2
        )
    )
    assert str(out) == "data/tiny_table_train"
    assert read_manifest(out)["settings"]["family"] == "table"
    problems = load_problems(out, load_robot(tiny_path))
    scenes, nodes = problems.problems.scene, problems.extras["roadmap_nodes"]
    for i in range(2):
        scene = jax.tree.map(lambda x, i=i: x[i], scenes)
        for q in nodes[i][problems.extras["roadmap_node_mask"][i]]:
            assert configuration_clearance(load_robot(tiny_path), scene, q) > 0


def test_an_arm_that_a_family_does_not_fit_and_an_unknown_family_are_named(tiny_path, monkeypatch):
    robot = load_robot(tiny_path)
    with pytest.raises(InputError, match=r"no family 'shelves'; there are .*'paper', 'shelf'"):
        labelled.generate_labelled(robot, 0, family="shelves")
    with pytest.raises(SystemExit):
        tyro.cli(GenerateConfig, args=["--family", "shelves"])
    monkeypatch.setattr(family_problem, "_MAX_SCENES", 0)
    generate_labelled = labelled.generate_labelled.__wrapped__  # as if it was not made before
    with pytest.raises(InputError, match=r"no start and goal for 2 of 2 problems .* 'window'"):
        generate_labelled(robot, 0, family="window")(problem_keys(0, "test", 0, 2, "window"))
