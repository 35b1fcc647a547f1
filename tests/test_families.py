"""Families: scenes that are what they say, and problems that are valid and reproducible."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tyro
from scipy.spatial.transform import Rotation

from experiments.draw_families import TITLES
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.collision.fused import obstacles_clear
from gnnjax.collision.obstacles import scene_faults
from gnnjax.errors import InputError
from gnnjax.generate import GenerateConfig, generate
from gnnjax.problems import family_problem, labelled
from gnnjax.problems.camera import HEIGHT, WIDTH, look_at
from gnnjax.problems.families import FAMILIES
from gnnjax.problems.family_problem import arm_reach, sample_family_problem
from gnnjax.problems.labelled import problem_keys
from gnnjax.problems.problem import Problem, sample_scene
from gnnjax.problems.shards import load_problems, read_manifest
from gnnjax.scene.cloud import Balls, cloud_of, make_cloud
from gnnjax.scene.lookup import lookup, squared_distance_to
from gnnjax.scene.mujoco_world import deepest_contact
from gnnjax.scene.scene import OBSTACLE_BUCKETS, is_axis_aligned, make_scene
from gnnjax.scene.shapes import KINDS, cylinder, kind_of

NUM_BOXES = {
    "shelf": (6, 8),
    "table": (5, 10),
    "window": (4, 4),
    "clutter": (10, 20),
    "bin": (5, 5),
    "cans": (6, 31),
    "pipes": (8, 14),
    "cloud_shelf": (0, 0),
}  # the scenes of "upright" are those of "shelf"
KINDS_OF = {
    "cans": {KINDS.index("box"), KINDS.index("cylinder")},
    "pipes": {KINDS.index("capsule"), KINDS.index("cylinder")},
    "cloud_shelf": set(),
}

# An arm that holds things upright unless its last joint turns.
LIFT = """
<mujoco model="lift">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom type="sphere" size="0.05" contype="1" conaffinity="1"/>
    <body name="mast">
      <joint name="up" type="slide" axis="0 0 1" range="-0.5 0.5"/>
      <joint name="a" axis="0 0 1" range="-3 3"/>
      <geom type="sphere" size="0.04" pos="0.2 0 0" mass="1"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="b" axis="0 0 1" range="-2.5 2.5"/>
        <joint name="c" axis="1 0 0" range="-0.5 0.5"/>
        <geom type="sphere" size="0.04" pos="0.15 0 0" mass="1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
BOTTLE = cylinder([0.3, 0, 0], radius=0.03, half_length=0.06)


@functools.cache
def many_scenes(family):
    keys = jax.random.split(jax.random.key(0), 200)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(FAMILIES[family]))(keys))


@functools.cache
def sampler(path, family):
    """A robot, and the function that draws a problem of a family for it."""
    robot = load_robot(path)
    if family == "upright":
        path = path.with_name("lift.xml")
        path.write_text(LIFT)
        robot = load_robot(path).attach("lower", [BOTTLE])
    check = make_checker(robot).check_configurations
    clear = functools.partial(obstacles_clear, robot, q=jnp.zeros(robot.num_dof), base_only=True)
    draw = functools.partial(
        sample_family_problem,
        family=family,
        robot=robot,
        check_configurations=check,
        obstacles_clear=clear,
    )
    return robot, draw, jax.jit(draw)


def tip_by_mujoco(robot, q):
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    return data.geom_xpos[robot.sphere_geoms[-1]]  # the tiny arm's last body has one geom


def axis_by_mujoco(robot, q):
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    return data.geom_xmat[robot.sphere_geoms[-1]].reshape(3, 3)[:, 2]


def inside(region, point):
    rotation = Rotation.from_quat(region.quat, scalar_first=True)
    return np.abs(rotation.inv().apply(point - region.center)) <= region.half_extents + 1e-5


@pytest.mark.parametrize("family", NUM_BOXES)
def test_scenes_fill_a_bucket_with_turned_obstacles_of_positive_size(family):
    drawn = many_scenes(family)
    scene = drawn.scene
    assert scene.mask.shape[1] in OBSTACLE_BUCKETS
    counts = scene.mask.sum(axis=1)
    low, high = NUM_BOXES[family]
    assert counts.min() >= low
    assert counts.max() <= high
    if family != "cans":  # whose numbers are of many throws of a coin
        assert (counts.min(), counts.max()) == (low, high)
    assert scene_faults(scene) == [None] * 200
    assert set(kind_of(scene.half_extents, scene.radii)[scene.mask]) == KINDS_OF.get(family, {0})
    np.testing.assert_allclose(np.linalg.norm(scene.quats, axis=-1), 1, atol=1e-5)
    assert (drawn.seen is not None) == (family == "cloud_shelf") == is_axis_aligned(scene)
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
            if family == "upright":  # spheres around a cylinder stand out of it
                assert deepest_contact(robot, problem.scene, q) is None
            else:
                assert configuration_clearance(robot, problem.scene, q) > 0
            assert ((q >= robot.joint_lower) & (q <= robot.joint_upper)).all()
            assert inside(region, tip_by_mujoco(robot, q)).all()
            if family == "upright":
                assert np.degrees(np.arccos(axis_by_mujoco(robot, q)[2])) < 11.5
        for one, again in zip(jax.tree.leaves(drawn), jax.tree.leaves(draw(key)), strict=True):
            np.testing.assert_array_equal(one, again)


def test_the_picture_shows_every_family():
    assert [*TITLES] == ["paper", *FAMILIES]


def test_a_batch_equals_single_draws(tiny_path):
    _, draw, single = sampler(tiny_path, "window")
    keys = jax.random.split(jax.random.key(0), 3)
    batch = jax.jit(jax.vmap(draw))(keys)
    for many, one in zip(jax.tree.leaves(batch), jax.tree.leaves(single(keys[1])), strict=True):
        np.testing.assert_allclose(many[1], one, atol=1e-5)


def test_what_stands_on_boards_stands_there_and_ends_are_in_empty_cells():
    drawn = many_scenes("cans")
    for i in range(200):
        scene = jax.tree.map(lambda x, i=i: x[i], drawn.scene)
        round_ones = np.flatnonzero(scene.mask & (scene.radii[:, 0] > 0))
        turn = Rotation.from_quat(scene.quats[0], scalar_first=True)
        ends = [jax.tree.map(lambda x, i=i: x[i], end) for end in (drawn.start, drawn.goal)]
        tops = scene.centers[3:7, 2] + scene.half_extents[3:7, 2]
        for k in round_ones:
            bottom = scene.centers[k, 2] - scene.half_extents[k, 2]
            tops_below = [
                *tops,
                *(scene.centers[round_ones, 2] + scene.half_extents[round_ones, 2]),
            ]
            assert np.abs(bottom - np.array(tops_below)).min() < 1e-5
            for end in ends:
                if end.half_extents.max() > 0.9:
                    continue  # anywhere outside
                away = np.abs(turn.inv().apply(scene.centers[k] - end.center))
                assert (away > end.half_extents)[[1, 2]].any()


def test_pipes_keep_away_from_the_middle_and_none_is_like_another():
    scene = many_scenes("pipes").scene
    axes = Rotation.from_quat(scene.quats[scene.mask], scalar_first=True).apply([0, 0, 1])
    centers = scene.centers[scene.mask]
    np.testing.assert_allclose((axes * centers).sum(axis=1), 0, atol=1e-5)
    assert (np.linalg.norm(centers, axis=1) > 0.34).all()
    assert 0.4 < (scene.radii[scene.mask][:, 1] > 0).mean() < 0.6


def test_the_camera_sees_what_mujocos_rays_hit():
    rng = np.random.default_rng(0)
    centers, sizes = rng.uniform(-0.5, 0.5, (5, 3)), rng.uniform(0.05, 0.25, (5, 3))
    scene = make_scene(centers, sizes, rng.normal(size=(5, 4)))
    camera, target = np.float32([1.1, -0.6, 0.8]), np.float32([0.1, 0.05, 0.0])
    seen = jax.jit(look_at)(jax.tree.map(jnp.asarray, scene), camera, target)
    spec = mujoco.MjSpec()
    for center, size, quat in zip(
        scene.centers[:5], scene.half_extents[:5], scene.quats[:5], strict=True
    ):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, size=size, quat=quat)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hit = np.isfinite(seen).all(axis=1)
    assert 500 < hit.sum() < 2500
    group, geom = np.ones(6, np.uint8), np.zeros(1, np.int32)
    for point in np.asarray(seen, float)[hit]:
        ray = (point - camera) / np.linalg.norm(point - camera)
        found = mujoco.mj_ray(model, data, camera.astype(float), ray, group, 1, -1, geom, None)
        assert found == pytest.approx(np.linalg.norm(point - camera), abs=1e-4)
    # A picture of what is missed: the rays go on from left to right, and from top to bottom.
    picture = hit.reshape(HEIGHT, WIDTH)
    assert picture.any(axis=0).sum() > 20
    assert picture.any(axis=1).sum() > 20
    forward = (target - camera) / np.linalg.norm(target - camera)
    found = mujoco.mj_ray(model, data, camera.astype(float), forward, group, 1, -1, geom, None)
    near = np.asarray(seen)[hit] - camera
    assert np.abs(near @ forward / np.linalg.norm(near, axis=1)).max() > 0.999
    assert found > 0


def test_a_cloud_made_in_a_compiled_function_is_that_made_outside():
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.6, 0.9, (300, 3)).astype(np.float32)
    points[rng.uniform(size=300) < 0.3, 1] = np.nan
    found = jax.tree.map(np.asarray, jax.jit(functools.partial(cloud_of, radius=0.02))(points))
    kept = points[np.isfinite(points).all(axis=1)]
    wanted = make_cloud([Balls(kept, 0.02)])
    assert found.num == wanted.num
    np.testing.assert_array_equal(found.points[: found.num], wanted.points[: wanted.num])
    assert sorted(found.points[: found.num].tolist()) == sorted(kept.tolist())
    assert not found.points[found.num :].any()
    for name in ("radius", "lower", "cells", "squared"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-6)
    nothing = jax.jit(functools.partial(cloud_of, radius=0.02))(
        np.full((10, 3), np.nan, np.float32)
    )
    assert int(nothing.num) == 0
    at = [jnp.float32([0.0, 0.5]), jnp.zeros(2), jnp.zeros(2)]
    assert (squared_distance_to(lookup(nothing), at) > 1.0).all()


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
    with pytest.raises(InputError, match="tiny holds nothing to be upright; "):
        labelled.generate_labelled(robot, 0, family="upright")(problem_keys(0, "test", 0, 2, "bin"))
    with pytest.raises(SystemExit):
        tyro.cli(GenerateConfig, args=["--family", "shelves"])
    monkeypatch.setattr(family_problem, "_MAX_SCENES", 0)
    generate_labelled = labelled.generate_labelled.__wrapped__  # as if it was not made before
    with pytest.raises(InputError, match=r"no start and goal for 2 of 2 problems .* 'window'"):
        generate_labelled(robot, 0, family="window")(problem_keys(0, "test", 0, 2, "window"))

    def none_found(key, robot, check, clear):
        nothing = jnp.zeros(robot.num_dof)
        return Problem(nothing, nothing, sample_scene(key, clear)), jnp.zeros(2, bool)

    monkeypatch.setattr(labelled, "draw_problem", none_found)
    with pytest.raises(InputError, match=r"no start and goal for 2 of 2 problems .* 'paper'"):
        generate_labelled(robot, 0)(problem_keys(0, "test", 0, 2))
