"""Roadmaps of unchecked nodes: what is in them, and how queries are joined with them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.roadmap.graph import default_radius
from gnnjax.roadmap.stored import (
    NUM_LOCAL,
    add_local_nodes,
    insert_ends,
    local_offsets,
    stored_roadmap,
)
from gnnjax.scene.mujoco_world import build_world

NUM = 60  # nodes, of 198 with the padding


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def stored(robot):
    return jax.tree.map(np.asarray, stored_roadmap(robot, NUM, 0))


@pytest.fixture(scope="module")
def widen(robot):
    """The compiled `add_local_nodes`, in whose eyes the first joint must not be negative."""
    radius = default_radius(robot, NUM + 2)
    limits = robot.joint_lower, robot.joint_upper

    @jax.jit
    def widened(offsets, stored, start, goal):
        def price(q):
            return jnp.where(q[:, 0] < 0, 9.0, 0.0)

        return add_local_nodes(offsets, stored, start, goal, radius, limits, price)

    def at(seed, *args):
        offsets = local_offsets(jax.random.key(seed), robot.num_dof)
        return jax.tree.map(np.asarray, widened(offsets, *args))

    return at


def edges(roadmap):
    """The set of `(node, neighbor)`, after a look at what every roadmap has to keep."""
    found = set()
    for i, k in np.argwhere(roadmap.neighbor_mask):
        j = int(roadmap.neighbors[i, k])
        assert (i, j) not in found
        assert i != j
        found.add((int(i), j))
        length = np.linalg.norm(roadmap.nodes[i] - roadmap.nodes[j])
        np.testing.assert_allclose(roadmap.lengths[i, k], length, atol=1e-5)
    assert all((j, i) in found for i, j in found)
    padding = ~roadmap.neighbor_mask
    own = np.broadcast_to(np.arange(len(roadmap.nodes))[:, None], padding.shape)
    np.testing.assert_array_equal(roadmap.neighbors[padding], own[padding])
    assert (roadmap.lengths[padding] == 0).all()
    assert all(roadmap.node_mask[i] for i, _ in found)
    return found


def test_stored_nodes_are_within_limits_and_free_of_self_collision(robot, stored):
    assert stored.node_mask.sum() == NUM
    assert len(stored.nodes) == 198
    model = build_world(robot, 0)
    data = mujoco.MjData(model)
    for q in stored.nodes[stored.node_mask]:
        assert ((q >= robot.joint_lower) & (q <= robot.joint_upper)).all()
        data.qpos[:] = q
        mujoco.mj_fwdPosition(model, data)
        assert (data.contact.dist[: data.ncon] > 0).all()


def test_stored_nodes_are_joined_within_the_radius(robot, stored):
    nodes = stored.nodes[:NUM].astype(float)
    near = cdist(nodes, nodes) <= default_radius(robot, NUM + 2)
    expected = {(int(i), int(j)) for i, j in np.argwhere(near) if i != j}
    assert stored.num_dropped == 0
    assert edges(stored) == expected


def test_stored_roadmaps_depend_on_the_seed_alone(robot, stored):
    stored_roadmap.cache_clear()
    again, other = (stored_roadmap(robot, NUM, seed) for seed in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, tuple(again), tuple(stored))
    assert len(set(map(bytes, np.asarray(other.nodes))) & set(map(bytes, stored.nodes))) <= 1


def test_an_arm_that_always_collides_is_refused(tmp_path):
    path = tmp_path / "stuck.xml"
    # Between two spheres, of which it touches one or the other wherever it turns.
    arm = '<mujoco><compiler angle="radian"/><worldbody><geom pos="0.44 0.24 0" size="0.35"/>'
    arm += '<geom pos="0.44 -0.24 0" size="0.35"/><body><joint range="-1 1" limited="true"/>'
    path.write_text(arm + '<geom pos="0.5 0 0" size="0.1"/></body></worldbody></mujoco>')
    with pytest.raises(InputError, match=r"stuck.xml. collides with itself in all of"):
        stored_roadmap(load_robot(path), 20, 0)


def test_start_and_goal_join_a_stored_roadmap(robot, stored):
    radius = default_radius(robot, NUM + 2)
    joined = jax.jit(lambda stored, start, goal: insert_ends(stored, start, goal, radius))
    rng = np.random.default_rng(0)
    before = {(i + 2, j + 2) for i, j in edges(stored)}
    for _ in range(3):
        ends = rng.uniform(robot.joint_lower, robot.joint_upper, (2, 3)).astype(np.float32)
        roadmap = jax.tree.map(np.asarray, joined(stored, *ends))
        np.testing.assert_array_equal(roadmap.nodes[:2], ends)
        np.testing.assert_array_equal(roadmap.nodes[2:], stored.nodes)
        found = edges(roadmap)
        assert {(i, j) for i, j in found if min(i, j) > 1} == before
        assert (0, 1) in found
        for end in range(2):
            apart = np.linalg.norm(stored.nodes[:NUM] - ends[end], axis=1)
            order = np.argsort(apart)[: stored.neighbors.shape[1] + 1]
            expected = {int(i) + 2 for i in order if apart[i] <= 1.3 * radius}
            assert len(expected) > 5
            assert {j for i, j in found if i == end and j > 1} == expected


def test_local_nodes_lie_around_the_ends_within_limits(robot, stored, widen):
    ends = np.array([[2.5, 1, 0], [-2, -1, 1]], np.float32)
    roadmap = widen(0, stored, *ends)
    num = 2 + 2 * NUM_LOCAL
    np.testing.assert_array_equal(roadmap.nodes[:2], ends)
    np.testing.assert_array_equal(roadmap.nodes[num:], stored.nodes)
    np.testing.assert_array_equal(roadmap.node_mask[num:], stored.node_mask)
    local = roadmap.nodes[2:num].reshape(2, NUM_LOCAL, 3)
    assert ((local >= robot.joint_lower) & (local <= robot.joint_upper)).all()
    apart = np.linalg.norm(local - ends[:, None], axis=-1)
    elsewhere = np.linalg.norm(stored.nodes[:NUM] - ends[:, None], axis=-1)
    assert (np.median(apart, axis=1) < np.median(elsewhere, axis=1) / 1.5).all()
    assert roadmap.node_mask[:num].all()
    # Around the start there are enough that look free; around the goal hardly any.
    assert (local[0, :, 0] >= 0).all()
    assert (local[1, :, 0] < 0).any()
    assert not np.array_equal(widen(1, stored, *ends).nodes[2:num], roadmap.nodes[2:num])


def test_ends_are_joined_with_their_local_nodes_and_with_each_other(robot, stored, widen):
    ends = np.array([[0.5, 1, 0], [1, -1, 1]], np.float32)
    roadmap = widen(0, stored, *ends)
    found = edges(roadmap)
    assert (0, 1) in found
    first = 2 + 2 * NUM_LOCAL
    apart = cdist(roadmap.nodes[:first], roadmap.nodes)
    for end in range(2):
        own = range(2 + end * NUM_LOCAL, 2 + (end + 1) * NUM_LOCAL)
        others = set(range(2, first)) - set(own)
        near = {j for i, j in found if i == end}
        assert near >= set(own)
        assert not near & others
        reach = 1.3 * default_radius(robot, NUM + 2)
        order = [j for j in np.argsort(apart[end]) if j >= first and roadmap.node_mask[j]]
        assert near - set(range(first)) == {j for j in order[:20] if apart[end, j] <= reach}
        joined = 0
        for node in own:
            around = {j for i, j in found if i == node}
            assert not around & others
            assert len(around & set(own)) <= 8
            # With some of the nearest stored nodes: with those that do not have nearer ones.
            order = [j for j in np.argsort(apart[node]) if j >= first and roadmap.node_mask[j]]
            assert around - set(range(first)) <= set(order[:20])
            joined += len(around - set(range(first)))
        assert joined > 2 * NUM_LOCAL
        for node in range(first, len(roadmap.nodes)):
            assert len({j for i, j in found if i == node} & set(own)) <= 8
    within = {(i, j) for i, j in found if min(i, j) >= first}
    assert within == {(i + first, j + first) for i, j in edges(stored)}


def test_an_end_in_the_place_of_a_stored_node_is_not_joined_with_it(robot, stored, widen):
    radius = default_radius(robot, NUM + 2)
    ends = stored.nodes[3], stored.nodes[5] + np.float32(1e-6)
    joined = jax.jit(lambda stored, start, goal: insert_ends(stored, start, goal, radius))
    for roadmap in (joined(stored, *ends), widen(0, stored, *ends)):
        roadmap = jax.tree.map(np.asarray, roadmap)
        first = len(roadmap.nodes) - len(stored.nodes)
        found = edges(roadmap)
        assert (0, 1) in found
        assert not {(0, first + 3), (1, first + 5)} & set(found)
        assert len([j for i, j in found if i == 0]) > 5
        assert roadmap.lengths[roadmap.neighbor_mask].min() > 1e-4


def test_nodes_that_the_limits_make_equal_are_left_out(robot, stored, widen):
    # An eighth of the draws around a corner of the limits is cut off to the corner itself. Edges
    # without length would lead a search around in circles.
    ends = np.array([robot.joint_upper, [1, 1, 0]], np.float32)
    roadmap = widen(0, stored, *ends)
    nodes = roadmap.nodes[2 : 2 + NUM_LOCAL]
    earlier = [np.array([ends[0], *nodes[:i]]) for i in range(len(nodes))]
    same = np.array(
        [(q == before).all(axis=1).any() for q, before in zip(nodes, earlier, strict=True)]
    )
    assert 1 <= same.sum() < NUM_LOCAL / 2
    np.testing.assert_array_equal(roadmap.node_mask[2 : 2 + NUM_LOCAL], ~same)
    assert roadmap.node_mask[:2].all()
    edges(roadmap)
    assert roadmap.lengths[roadmap.neighbor_mask].min() > 0
