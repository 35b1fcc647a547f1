"""Distances of the arm's points, and the edge validity and prices that come from them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import nnx
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from gnnjax.arm.robot import load_robot
from gnnjax.guide.view import arm_view, choose_points, point_distances
from gnnjax.paper.validity import RISK_WEIGHT, ValidityHead, cost_through, edge_distances
from gnnjax.roadmap.graph import connect
from gnnjax.scene.scene import make_scene


def random_scene(rng, num=4):
    quats = rng.normal(size=(num, 4))
    return make_scene(rng.uniform(-0.8, 0.8, (num, 3)), rng.uniform(0.05, 0.4, (num, 3)), quats)


def signed_distance(point, center, half_extents, quat):
    local = Rotation.from_quat(quat, scalar_first=True).inv().apply(point - center)
    beyond = np.abs(local) - half_extents
    return np.linalg.norm(np.maximum(beyond, 0)) + min(beyond.max(), 0)


def test_distances_agree_with_mujocos_points_and_plain_geometry(tiny_path):
    robot, rng = load_robot(tiny_path), np.random.default_rng(0)
    scene = random_scene(rng)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (20, 3)).astype(np.float32)
    found = jax.jit(point_distances(robot, 3))(jax.tree.map(jnp.asarray, scene), jnp.asarray(q))
    data, geoms = mujoco.MjData(robot.mj_model), robot.sphere_geoms[list(choose_points(robot, 3))]
    signs = set()
    for row, configuration in zip(np.asarray(found), q, strict=True):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(robot.mj_model, data)
        for value, geom in zip(row, geoms, strict=True):
            boxes = zip(scene.centers, scene.half_extents, scene.quats, scene.mask, strict=True)
            expected = min(signed_distance(data.geom_xpos[geom], *b) for *b, m in boxes if m)
            np.testing.assert_allclose(value, expected, atol=2e-6)
            signs.add(expected > 0)
    assert signs == {True, False}


def test_a_scene_without_boxes_is_far_away(tiny_path):
    robot = load_robot(tiny_path)
    scene = jax.tree.map(jnp.asarray, make_scene([], []))
    found = jax.jit(point_distances(robot, 3))(scene, np.zeros((2, 3), np.float32))
    np.testing.assert_array_equal(found, 10.0)


@pytest.mark.parametrize("name", ["kuka_iiwa14", "kinova_gen3", "franka_panda"])
def test_points_are_spread_over_the_moving_arm(name):
    robot = load_robot(name)
    points = choose_points(robot, 12)
    assert len(set(points)) == 12
    bodies = robot.sphere_bodies[list(points)]
    assert (np.diff(bodies) >= 0).all()  # from the base to the tip
    assert bodies.min() > 0
    assert len(set(bodies.tolist())) >= 5


def test_an_arm_with_few_geoms_repeats_some(tiny_path):
    points = choose_points(load_robot(tiny_path), 5)
    assert len(points) == 5
    assert len(set(points)) == 3


def make_roadmap(num=30):
    nodes = np.random.default_rng(0).random((num, 3), np.float32)
    return jax.jit(connect, static_argnums=3)(nodes, np.ones(num, bool), 0.5, 20)


def distances(q):
    return jnp.stack([jnp.sin(9 * q[:, 0]), jnp.cos(7 * q[:, 1])], axis=1)


def test_edge_distances_do_not_depend_on_the_direction():
    roadmap = make_roadmap()
    near, far, nodes = np.arange(10), np.arange(10, 20), np.asarray(roadmap.nodes)
    along = jax.jit(lambda *ends: edge_distances(roadmap.nodes, *ends, 10, distances))
    there, back = along(near, far), along(far, near)
    np.testing.assert_allclose(there, back, atol=1e-5)
    middle = (nodes[near] + nodes[far]) / 2
    np.testing.assert_allclose(there[:, -2:], distances(middle), atol=1e-5)
    ends = np.stack([distances(nodes[near]), distances(nodes[far])])
    np.testing.assert_allclose(there[:, :2], ends.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(there[:, 2:4], ends.max(axis=0), atol=1e-6)


def test_edge_distances_are_the_same_in_blocks(monkeypatch):
    nodes = make_roadmap().nodes
    near, far = np.arange(10), np.arange(10, 20)

    def along():
        return jax.jit(lambda *edges: edge_distances(nodes, *edges, distances))

    whole = along()(near, far, 10)
    monkeypatch.setattr("gnnjax.paper.validity._ROWS_A_BLOCK", 6)
    in_blocks = along()
    np.testing.assert_allclose(in_blocks(near, far, 10), whole, atol=1e-6)
    few = np.asarray(in_blocks(near, far, 2))
    np.testing.assert_allclose(few[:2], whole[:2], atol=1e-6)
    assert (few[5:, 4:] == 0).all()  # blocks of padding are not looked at


def test_logits_are_symmetric_and_zero_on_padding():
    roadmap = make_roadmap()
    head = ValidityHead(3, 8, 2, rngs=nnx.Rngs(0))
    size = roadmap.neighbors.size
    logits = np.asarray(jax.jit(lambda r: head(r, r.nodes, distances, size))(roadmap))
    mask = np.asarray(roadmap.neighbor_mask)
    assert (logits[~mask] == 0).all()
    table = np.full((30, 30), np.nan)
    for i, k in np.argwhere(mask):
        table[i, roadmap.neighbors[i, k]] = logits[i, k]
    np.testing.assert_array_equal(table, table.T)
    assert np.nanstd(table) > 1e-3


def test_the_cost_through_a_neighbor_agrees_with_dijkstra():
    roadmap = make_roadmap()
    mask = np.asarray(roadmap.neighbor_mask)
    neighbors = np.asarray(roadmap.neighbors)
    logits = np.zeros(mask.shape, np.float32)
    rng, price = np.random.default_rng(0), np.zeros((30, 30))
    draws = rng.normal(scale=3, size=(30, 30))
    for i, k in np.argwhere(mask):
        a, b = sorted((i, neighbors[i, k]))
        logits[i, k] = draws[a, b]
        price[i, neighbors[i, k]] = roadmap.lengths[i, k] + RISK_WEIGHT * np.log1p(
            np.exp(-draws[a, b])
        )
    cost = dijkstra(csr_matrix(price), indices=1)
    through = np.asarray(jax.jit(cost_through)(roadmap, logits))
    for i, k in np.argwhere(mask):
        j = neighbors[i, k]
        np.testing.assert_allclose(through[i, k], price[i, j] + cost[j], rtol=1e-4)


def test_an_arms_view_agrees_with_mujocos_points_and_plain_geometry(tiny_path):
    robot, rng, num = load_robot(tiny_path), np.random.default_rng(1), 3
    scene = random_scene(rng)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (40, 3)).astype(np.float32)
    found = jax.jit(arm_view(robot, num))(scene, q)
    data, chosen = mujoco.MjData(robot.mj_model), list(choose_points(robot, num))
    bodies = robot.sphere_bodies
    touching = {(bodies[a], bodies[b]) for a, b in robot.sphere_pairs}
    boxes = list(zip(scene.centers, scene.half_extents, scene.quats, scene.mask, strict=True))
    near = set()
    for i, configuration in enumerate(q):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(robot.mj_model, data)
        points = data.geom_xpos[robot.sphere_geoms[chosen]]
        radii = robot.mj_model.geom_size[robot.sphere_geoms[chosen], 0]
        np.testing.assert_allclose(found.points[i], points, atol=2e-6)
        for p in range(num):
            expected = min(signed_distance(points[p], *b) for *b, exists in boxes if exists)
            np.testing.assert_allclose(found.clearance[i, p], expected - radii[p], atol=2e-6)
        gaps = [1.0]  # what lies beyond does not count
        for a in range(num):
            for b in range(num):
                if (bodies[chosen[a]], bodies[chosen[b]]) in touching:
                    gaps.append(np.linalg.norm(points[a] - points[b]) - radii[a] - radii[b])
        np.testing.assert_allclose(found.clearance[i, num], min(gaps), atol=2e-6)
        near.add(min(gaps) < 0.2)
    assert near == {True, False}


def test_an_arms_view_without_boxes_is_far_from_them(tiny_path):
    robot = load_robot(tiny_path)
    scene = jax.tree.map(jnp.asarray, make_scene([], []))
    seen = jax.jit(arm_view(robot, 5))(scene, np.zeros((2, 3), np.float32))
    radii = robot.sphere_radii[list(choose_points(robot, 5))]
    np.testing.assert_allclose(seen.clearance[:, :5], np.tile(10 - radii, (2, 1)), rtol=1e-6)
