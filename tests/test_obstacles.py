"""Obstacles of every kind: in the kernels, certificates, fields and files, against the C engine."""

import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.engine import Engine
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import clearances
from gnnjax.collision.fused import obstacles_clear
from gnnjax.errors import InputError
from gnnjax.paper.occupancy import occupancy_grid
from gnnjax.planning.query import check_queries
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.problems.shards import load_problems
from gnnjax.scene.field import distance_field, make_grid
from gnnjax.scene.mujoco_world import build_world, obstacles, place_obstacles
from gnnjax.scene.scene import Scene, inflated, scene_from_shapes
from gnnjax.scene.scene_file import scene_from_json, scene_to_json
from gnnjax.scene.shapes import (
    KINDS,
    Sums,
    box,
    capsule,
    cylinder,
    described,
    half_space,
    kind_of,
    sphere,
)
from tests.draws import random_configurations

CAPSULE = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom contype="1" conaffinity="1" mass="1"/></default>
  <worldbody>
    <body>
      <joint axis="0 0 1" range="-3 3"/>
      <joint axis="0 1 0" range="-3 3"/>
      <geom type="capsule" fromto="0 0 0.1 0.1 0 0.6" size="0.05"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def stick(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "stick.xml"
    path.write_text(CAPSULE)
    return load_robot(path)


def draw_shape(rng, kind, reach):
    center, quat = rng.uniform(-reach, reach, 3), rng.normal(size=4)
    radius, length = rng.uniform(0.05, 0.3), rng.uniform(0.05, 0.3)
    if kind == "half_space":
        normal = rng.normal(size=3)
        return half_space(-rng.uniform(0.5, 1.0) * normal / np.linalg.norm(normal), 3 * normal)
    if kind == "sphere":
        return sphere(center, radius)
    if kind == "box":
        return box(center, rng.uniform(0.05, 0.25, 3), quat)
    return {"capsule": capsule, "cylinder": cylinder}[kind](center, radius, length, quat)


def draw_scene(rng, num=5, reach=0.9, kinds=KINDS) -> Scene:
    return scene_from_shapes([draw_shape(rng, kinds[i % len(kinds)], reach) for i in range(num)])


def on_device(shapes) -> Scene:
    return jax.tree.map(jnp.asarray, scene_from_shapes(shapes))


def stacked(scenes) -> Scene:
    return jax.tree.map(lambda *x: np.stack(x), *scenes)


def engine_distances(robot, scene, q):
    """`[B, M]` m from each obstacle to the arm; negative where they touch."""
    model = build_world(robot, len(scene.mask))
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene)
    placed = obstacles(model, len(scene.mask)).geoms
    moving = [g for g in robot.sphere_geoms.tolist() if model.body_weldid[model.geom_bodyid[g]]]
    found = np.full((len(q), len(scene.mask)), np.inf)
    for row, at in enumerate(np.asarray(q, float)):
        data.qpos[:] = at
        mujoco.mj_kinematics(model, data)
        for i in np.flatnonzero(scene.mask):
            found[row, i] = min(
                mujoco.mj_geomDistance(model, data, g, int(placed[i]), 10.0, None) for g in moving
            )
    return found


@pytest.mark.parametrize("arm", ["tiny", "stick"])
def test_kernels_and_certificate_agree_with_the_c_engine_on_every_kind(arm, tiny, stick):
    robot, rng = {"tiny": tiny, "stick": stick}[arm], np.random.default_rng(0)
    scenes = [draw_scene(rng, num) for num in (5, 10, 3, 7)]
    q = random_configurations(rng, robot, 200)
    checker = make_checker(robot)
    check, clearance = jax.jit(checker.check_configurations), jax.jit(checker.clearance)
    by_itself = np.asarray(clearance(scene_from_shapes([]), q))
    blocked_by = np.zeros(len(KINDS), int)
    for scene in scenes:
        apart = engine_distances(robot, scene, q)
        nearest = np.minimum(apart.min(axis=1), by_itself)
        valid, found = np.asarray(check(scene, q)), np.asarray(clearance(scene, q))
        sure = np.abs(nearest) > 1e-4
        np.testing.assert_array_equal(valid[sure], (nearest > 0)[sure])
        clear = (nearest > 1e-4) & (nearest < 5)
        # Capsules of the arm are chains of spheres that enclose them.
        thick = 0.0 if arm == "tiny" else 0.01
        assert (found[clear] <= nearest[clear] + 2e-5).all()
        assert (found[clear] >= nearest[clear] - thick - 2e-5).all()
        proven = clearances(robot, scene, q)
        assert (proven[clear] <= nearest[clear] + 1e-5).all()
        assert (proven[clear] >= nearest[clear] - thick - 1e-5).all()
        assert (proven[nearest < -1e-4] <= 0).all()
        kinds = kind_of(scene.half_extents, scene.radii)
        for i in np.flatnonzero(scene.mask):
            blocked_by[kinds[i]] += int((apart[:, i] < -1e-4).sum())
    assert (blocked_by >= 5).all()
    # One configuration in each of many scenes.
    owner = np.arange(len(q)) % len(scenes)
    placed = checker.place(stacked(scenes))
    each = np.asarray(jax.jit(checker.check_each)(placed, owner, q[:, None]))[:, 0]
    alone = np.stack([np.asarray(check(scene, q)) for scene in scenes])
    np.testing.assert_array_equal(each, alone[owner, np.arange(len(q))])


def test_certified_edges_are_free_for_the_c_engine(tiny):
    rng, certified = np.random.default_rng(1), 0
    for _ in range(6):
        scene = draw_scene(rng, 6, reach=1.2)
        starts, ends = (random_configurations(rng, tiny, 60) for _ in range(2))
        starts, ends = starts, starts + 0.3 * (ends - starts)
        holds = certify_edges(tiny, scene, starts, ends)
        engine = Engine(tiny, scene)
        for start, end in zip(starts[holds], ends[holds], strict=True):
            assert engine.valid(np.linspace(start, end, 40)).all()
        certified += int(holds.sum())
    assert 50 < certified < 340


def test_obstacles_in_the_base_are_found_by_kind(tiny):
    rng = np.random.default_rng(2)
    scene = draw_scene(rng, 10, reach=0.3)
    model = build_world(tiny, len(scene.mask))
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene)
    mujoco.mj_kinematics(model, data)
    (base,) = (g for g in tiny.sphere_geoms.tolist() if not model.body_weldid[model.geom_bodyid[g]])
    apart = [
        mujoco.mj_geomDistance(model, data, base, int(g), 10.0, None)
        for g in obstacles(model, len(scene.mask)).geoms
    ]
    found = obstacles_clear(tiny, jax.tree.map(jnp.asarray, scene), jnp.zeros(3), base_only=True)
    np.testing.assert_array_equal(found, np.array(apart) > 0)
    assert 0 < np.sum(found) < 10


def test_the_field_is_the_distance_to_any_kind():
    rng = np.random.default_rng(3)
    grid = make_grid(np.full(3, -1.0), np.full(3, 1.0), 8)
    field = jax.jit(distance_field(grid))
    axis = np.asarray(grid.lower[0]) + (np.arange(8) + 0.5) * grid.cell
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    spec = mujoco.MjSpec()
    for i in range(10):
        spec.worldbody.add_body(name=f"o{i}", mocap=True).add_geom(size=[0.1, 0.1, 0.1])
    spec.worldbody.add_body(name="point", mocap=True).add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0, 0]
    )
    for kind in KINDS:
        scene = draw_scene(rng, 1, 0.6, (kind,))
        robot_world = spec.compile()
        data = mujoco.MjData(robot_world)
        at = obstacles(robot_world, 11)
        place_boxes_of(robot_world, data, scene, at)
        found = np.asarray(field(scene))
        mujoco.mj_kinematics(robot_world, data)
        apart = np.empty(len(points))
        for row, point in enumerate(points):
            data.mocap_pos[10] = point
            mujoco.mj_kinematics(robot_world, data)
            apart[row] = mujoco.mj_geomDistance(robot_world, data, 10, 0, 200.0, None) + 1e-3
        outside = apart > 2e-3
        assert outside.sum() > 50
        np.testing.assert_allclose(found[outside], np.minimum(apart[outside], 10), atol=1e-4)
        assert (found[apart < 0] < 1e-3).all()


def place_boxes_of(model, data, scene, at):
    """The first obstacle of a scene, in a world that has a point beside its obstacles."""
    one = jax.tree.map(lambda x: np.concatenate([x, x[:1]])[:11], scene)
    place_obstacles(model, data, one._replace(mask=np.r_[scene.mask, False]))
    del at


def test_the_occupancy_grid_shows_every_kind_and_nothing_vanishes():
    lower, upper = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    one = [
        sphere([0, 0, 0], 0.3),
        capsule([0, 0, 0], 0.3, 0.4),
        cylinder([0, 0, 0], 0.3, 0.4),
        half_space([0, 0, -0.5], [0, 0, 1]),
    ]
    share = [float(np.mean(occupancy_grid(on_device([s]), lower, upper, 40))) for s in one]
    volume = np.pi * np.array([0.3**3 * 4 / 3, 0.3**2 * (0.8 + 0.4), 0.3**2 * 0.8, 2 / np.pi])
    np.testing.assert_allclose(np.array(share) * 8, volume, rtol=0.05)
    thin = [
        sphere([0.01, 0, 0], 0.001),
        capsule([0, 0.01, 0], 0.001, 0.4),
        cylinder([0] * 3, 1e-3, 1.0),
    ]
    for shape in thin:
        assert occupancy_grid(on_device([shape]), lower, upper, 10).sum() > 0


def assert_same_obstacles(first: Scene, second: Scene):
    np.testing.assert_array_equal(first.mask, second.mask)
    for a, b in zip(first[:4], second[:4], strict=True):
        np.testing.assert_allclose(a[first.mask], b[first.mask], atol=1e-5)


def test_files_give_back_every_kind(tmp_path, tiny):
    rng = np.random.default_rng(4)
    scenes = [draw_scene(rng, num) for num in (0, 1, 5, 10)]
    for scene in scenes:
        scene_to_json(scene, tmp_path / "scene.json")
        assert_same_obstacles(scene_from_json(tmp_path / "scene.json"), scene)
    q = random_configurations(rng, tiny, len(scenes))
    save_problems(tmp_path / "set.npz", ProblemSet("tiny", Problem(q, q, stacked(scenes))))
    assert_same_obstacles(load_problems(tmp_path / "set.npz", tiny).problems.scene, stacked(scenes))
    with np.load(tmp_path / "set.npz") as arrays:
        kept = dict(arrays)
    assert kept["num_cylinders"].tolist() == [0, 0, 1, 2]
    for lost in ("num_cylinders", "cylinder_radii"):
        left = {name: value for name, value in kept.items() if name != lost}
        np.savez(tmp_path / "lost.npz", **left)
        with pytest.raises(InputError, match=rf"lacks \['{lost}'\]; its cylinders need"):
            load_problems(tmp_path / "lost.npz", tiny)
    kept["cylinder_radii"][2, 0] = -1
    np.savez(tmp_path / "bad.npz", **kept)
    with pytest.raises(InputError, match=r"cylinder_radii of problem 2 \(cylinder 0\) .* positive"):
        load_problems(tmp_path / "bad.npz", tiny)


def test_a_half_space_is_where_it_was_said_to_be():
    rng = np.random.default_rng(5)
    for normal in (*rng.normal(size=(20, 3)), [0, 0, 1.0], [0, 0, -1.0], [1e-9, 0, -1.0]):
        normal = np.asarray(normal) / np.linalg.norm(normal)
        point = rng.uniform(-1, 1, 3) + 300 * np.cross(normal, [0.3, 0.5, 0.2])
        scene = scene_from_shapes([half_space(point, 2 * normal)])
        (back,) = (described("half_space", Sums._make(x[:1] for x in scene[:4])),)
        np.testing.assert_allclose(back["normal"][0], normal, atol=1e-6)
        assert abs((back["point"][0] - point) @ normal) < 5e-5


@pytest.mark.parametrize(
    ("name", "entry", "message"),
    [
        (
            "spheres",
            {"center": [0, 0, 1], "radius": 0},
            r"sphere 0 .* radius \[0.0\]; it must be pos",
        ),
        ("spheres", {"center": [0, 0, 1], "radius": "1"}, "radius = '1'; give a number"),
        ("spheres", {"center": [0, 0, 1], "radius": [1]}, r"radius = \[1\]; give a number"),
        (
            "spheres",
            {"center": [0, 0, 1], "radius": 1, "quat": [1, 0, 0, 0]},
            "give center, radius",
        ),
        ("cylinders", {"center": [0, 0, 1], "radius": 1}, "half_length = None; give a number"),
        ("capsules", {"center": [0, 0, 1], "radius": 1, "length": 2}, "if rotated, quat"),
        ("half_spaces", {"point": [0, 0, 1], "normal": [0, 0, 0]}, "give a direction, not zeros"),
        ("half_spaces", {"point": [0, 0, 90], "normal": [0, 0, 1]}, "leaves no arm any room"),
        ("cylinders", {"center": [0, 0, 1], "radius": 1e5, "half_length": 1}, "below 10000 m"),
    ],
)
def test_what_is_wrong_with_an_obstacle_is_named(tmp_path, name, entry, message):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps({name: [entry]}))
    with pytest.raises(InputError, match=message):
        scene_from_json(path)


@pytest.mark.parametrize(
    ("half_extents", "radii"),
    [
        ([0.1, 0.1, 0.0], [0.0, 0.0]),  # flat
        ([0.0, 0.0, 0.0], [0.1, 0.0]),  # a disc without a height
        ([0.0, 0.0, 0.0], [0.0, 0.0]),
        ([0.1, 0.1, 0.1], [-0.01, 0.0]),
        ([0.1, 0.1, 0.1], [0.0, np.nan]),
        ([0.0, 0.0, -0.1], [0.0, 0.1]),
    ],
)
def test_nothing_is_certified_among_obstacles_that_are_none(tiny, half_extents, radii):
    scene = draw_scene(np.random.default_rng(6), 3, 3.0)
    scene.half_extents[0], scene.radii[0] = half_extents, radii
    with pytest.raises(InputError, match="obstacle 0 of the scene has half_extents and radii"):
        certify_edges(tiny, scene, np.zeros((1, 3)), np.zeros((1, 3)))


def test_a_margin_makes_obstacles_as_large_as_what_is_within_it(tiny):
    rng = np.random.default_rng(7)
    scene = draw_scene(rng, 5, 1.0)
    q = random_configurations(rng, tiny, 200)
    thick = inflated(scene, 0.07)
    alone = clearances(tiny, scene_from_shapes([]), q)
    expected = np.minimum(engine_distances(tiny, scene, q).min(axis=1) - 0.07, alone)
    found = clearances(tiny, thick, q)
    clear = expected > 1e-4
    np.testing.assert_allclose(found[clear], np.minimum(expected, alone)[clear], atol=2e-5)
    assert (found[expected < -1e-4] <= 0).all()
    checked = jax.jit(make_checker(tiny).check_configurations)(thick, q)
    sure = np.abs(expected) > 1e-4
    np.testing.assert_array_equal(np.asarray(checked)[sure], (expected > 0)[sure])
    reasons = check_queries(tiny, Problem(q, q, stacked([scene] * len(q))), margin=0.07)
    # Some are in the base, which is told first.
    within = (expected < -1e-4) & (expected > -0.07 + 1e-4) & (alone > 1e-4)
    assert within.sum() > 10
    told = [reasons[i] for i in np.flatnonzero(within)]
    assert all("within the margin of 70 mm" in reason for reason in told)
