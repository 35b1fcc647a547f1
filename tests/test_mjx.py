"""MJX against MuJoCo's C engine and the fused kernel, and the commands that run on it."""

import contextlib
import dataclasses
import functools
import io
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import compare_labels
from experiments.compare_labels import CompareConfig, main
from experiments.engine import Engine
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.collision.contact_maps import ContactMaps
from gnnjax.collision.mjx import _placer
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.generate import GenerateConfig, generate
from gnnjax.scene.scene import inflated, scene_from_shapes
from gnnjax.scene.shapes import box, capsule, cylinder, half_space, sphere
from tests.draws import random_boxes, random_configurations

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

NUM = 400  # configurations in a batch: kernels are compiled once
MARGIN = 1e-3  # m; the C engine reports contacts this far apart, too

# Geoms of all kinds, among them one that is fixed to the world.
MIXED = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom contype="1" conaffinity="1" mass="1"/></default>
  <asset><mesh name="rock" vertex="0 0 0 .2 0 0 0 .1 0 0 0 .15 .1 .1 .1"/></asset>
  <worldbody>
    <geom type="sphere" size="0.04"/>
    <body>
      <joint axis="0 0 1" range="-3 3"/>
      <geom type="capsule" fromto="0 0 0.1 0.1 0 0.4" size="0.05"/>
      <body pos="0.1 0 0.45">
        <joint axis="0 1 0" range="-2.6 2.6"/>
        <geom type="box" pos="0 0.04 0.15" euler="0.3 0.4 0.5" size="0.06 0.04 0.09"/>
        <body pos="0 0 0.3">
          <joint axis="0.6 0.8 0" range="-2.6 2.6"/>
          <geom type="mesh" mesh="rock" pos="0 0 0.1" euler="0.5 0.2 0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "mixed.xml"
    path.write_text(MIXED)
    return load_robot(path)


def engine_gaps(robot, scene, q):
    return Engine(robot, scene, MARGIN).gaps(np.asarray(q, float))


def test_it_matches_the_fused_kernel_and_the_c_engine(tiny):
    rng = np.random.default_rng(4)
    fused = jax.jit(make_checker(tiny).check_configurations)
    checker = make_checker(tiny, "mjx")
    check, clearance = jax.jit(checker.check_configurations), jax.jit(checker.clearance)
    for num_boxes in (0, 3, 9):
        scene, q = random_boxes(rng, num_boxes), random_configurations(rng, tiny, 200)
        gaps = engine_gaps(tiny, scene, q)
        sure = np.abs(gaps) > 1e-4
        valid = np.asarray(check(scene, q))
        assert (valid == (gaps > 0))[sure].all()
        assert (valid == np.asarray(fused(scene, q)))[sure].all()
        # Penetration depths are distances in MJX, too.
        deep = gaps < -1e-4
        np.testing.assert_allclose(clearance(scene, q)[deep], gaps[deep], atol=1e-4)
    assert jax.eval_shape(clearance, scene, q.reshape(2, 100, -1)).shape == (2, 100)


def random_world(rng, num, reach=0.9):
    """Obstacles of all kinds, some of each."""
    centers, sizes = rng.uniform(-reach, reach, (4, num, 3)), rng.uniform(0.03, 0.2, (4, num, 3))
    quats = rng.normal(size=(3, num, 4))
    shapes = [box(*at) for at in zip(centers[0], sizes[0], quats[0], strict=True)]
    shapes += [sphere(*at) for at in zip(centers[1], sizes[1, :, 0].tolist(), strict=True)]
    for kind, k in ((capsule, 1), (cylinder, 2)):
        radii, half_lengths = sizes[k + 1, :, :2].T.tolist()
        at = zip(centers[k + 1], radii, half_lengths, quats[k], strict=True)
        shapes += [kind(*one) for one in at]
    shapes.append(half_space([0, 0, -0.6], [0.1, 0.2, 1]))
    return jax.tree.map(jnp.asarray, scene_from_shapes(shapes))


@functools.cache
def kernel(robot):
    return jax.jit(make_checker(robot, "mjx").check_configurations)


@pytest.mark.parametrize("name", ["kuka_iiwa14", "mixed"])
def test_verdicts_are_those_of_the_fused_kernels_spheres(name, request, monkeypatch):
    robot = load_robot(name) if name == "kuka_iiwa14" else request.getfixturevalue(name)
    rng = np.random.default_rng(5)
    none = np.empty((0, 2), int)
    monkeypatch.setattr(
        "gnnjax.collision.fused.contact_maps",
        lambda robot: ContactMaps((), (), none, robot.sphere_pairs),
    )
    fused = make_checker(robot)
    first = jax.jit(fused.levels.first)
    num_valid, by_itself, differ = 0, 0, 0
    for num_boxes in (0, 4, 9):
        scene, q = random_boxes(rng, num_boxes), random_configurations(rng, robot, NUM)
        valid = np.asarray(kernel(robot)(scene, q))
        placed = fused.place(jax.tree.map(lambda x: x[None], scene))
        found = np.asarray(first(placed, np.zeros(1, np.int32), q[None]))[0] == 0
        differ += (valid != found).sum()
        num_valid += valid.sum()
        by_itself += (~valid).sum() if num_boxes == 0 else 0
    assert differ <= 1  # where spheres touch, to within rounding
    # Both outcomes and self-collisions must have been there.
    assert NUM * 1.5 < num_valid < NUM * 2.9
    assert by_itself > 0


def test_obstacles_of_all_kinds_are_those_of_the_c_engine(tiny):
    rng = np.random.default_rng(8)
    check = jax.jit(make_checker(tiny, "mjx").check_configurations)
    scene, q = random_world(rng, 3, 0.6), random_configurations(rng, tiny, 200)
    gaps = engine_gaps(tiny, scene, q)
    valid = np.asarray(check(scene, q))
    assert (valid == (gaps > 0))[np.abs(gaps) > 1e-4].all()
    assert 40 < valid.sum() < 160


def test_a_margin_is_kept_of_obstacles_of_all_kinds(tiny):
    rng = np.random.default_rng(9)
    world, q = random_world(rng, 3, 0.6), random_configurations(rng, tiny, 200)
    apart = [
        np.asarray(jax.jit(make_checker(tiny, kind).check_configurations)(inflated(world, 0.05), q))
        for kind in ("mjx", "fused")
    ]
    # Edges of boxes and cylinders are not rounded here, so some more are refused.
    assert not (apart[0] & ~apart[1]).any()
    assert 10 < apart[0].sum() <= apart[1].sum() < 150


def test_what_is_free_by_mjx_is_free_by_the_c_engine(mixed):
    rng = np.random.default_rng(6)
    num_valid = 0
    for num_boxes in (0, 4, 9):
        scene, q = random_boxes(rng, num_boxes, reach=1.2), random_configurations(rng, mixed, NUM)
        valid = np.asarray(kernel(mixed)(scene, q))
        assert (engine_gaps(mixed, scene, q)[valid] > 0).all()
        num_valid += valid.sum()
    assert 500 < num_valid < 1190


def test_poses_are_those_of_mjx(tiny):
    q = random_configurations(np.random.default_rng(7), tiny, 3)
    rows = np.arange(len(tiny.sphere_radii))
    model = mjx.put_model(tiny.mj_model, impl="jax")
    data = mjx.make_data(tiny.mj_model, impl="jax")
    expected = jax.jit(jax.vmap(lambda q: mjx.kinematics(model, data.replace(qpos=q))))(q)
    placed = _placer(tiny, jnp.asarray(q))(rows)
    full = [np.broadcast_to(x, (len(rows), len(q))) for x in placed.position.flat]
    position = np.stack(full, axis=-1).swapaxes(0, 1)  # [B G 3]
    np.testing.assert_allclose(position, expected.geom_xpos[:, tiny.part_geoms], atol=1e-5)


@pytest.fixture(scope="module")
def problems(tiny, tmp_path_factory):
    out = tmp_path_factory.mktemp("problems") / "problems.npz"
    return generate(GenerateConfig("test", robot=str(tiny.path), num_problems=4, seed=3, out=out))


def test_plans_are_those_with_the_fused_kernel(tiny, problems, tmp_path):
    found = {}
    for checker in ("mjx", "fused"):
        config = EvaluateConfig(
            problems=problems,
            json=tmp_path / f"{checker}.json",
            robot=str(tiny.path),
            num_nodes=40,
            max_roadmaps=2,
            checker=checker,
        )
        found[checker] = evaluate(config)
        assert found[checker]["settings"]["planner"] == "guided"
    rows = [result["problems"] for result in found.values()]
    assert any(row["certified"] for row in rows[0])
    for ours, theirs in zip(*rows, strict=True):
        for field in ("success", "path", "edge_checks", "configuration_checks"):
            assert ours[field] == theirs[field]


def test_labels_of_all_backends_are_compared(tiny, tmp_path, capsys):
    path = tmp_path / "labels.json"
    main(CompareConfig(robot=str(tiny.path), edges=300, num_nodes=40, json=path))
    found = json.loads(path.read_text())
    assert found["edges"] >= 300
    assert found["scenes"] > 1
    assert 0 < found["valid"] < found["edges"] < found["configurations"]
    assert found["wrongly_valid"] == found["needlessly_blocked"] == {"fused": 0, "mjx": 0}
    assert found["valid_by_mjx_alone"] == 0
    assert "mjx: 0 wrongly valid, 0 needlessly blocked" in capsys.readouterr().out


def test_a_judge_that_errs_is_named_with_the_engines_distance(tiny, monkeypatch, capsys):
    thin = dataclasses.replace(tiny, sphere_radii=tiny.sphere_radii - 0.01)
    monkeypatch.setattr(
        compare_labels,
        "make_checker",
        lambda robot, judge: make_checker(thin if judge == "mjx" else robot),
    )
    found = main(CompareConfig(robot=str(tiny.path), edges=300, num_nodes=40))
    wrong = found["errors"]
    assert len(wrong) == found["wrongly_valid"]["mjx"] == found["valid_by_mjx_alone"] > 0
    for row in wrong:
        assert row["judge"] == "mjx"
        assert -20.1 < row["engine_mm"] <= 0.0  # two spheres, each 10 mm thinner
    assert "mjx says valid, the engine's distance there is -" in capsys.readouterr().out
