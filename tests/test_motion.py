"""The motion network and its prices: layers against NumPy, and laws."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.guide.guide import Prices
from gnnjax.guide.motion import SPACING, MotionNetwork, make_prices
from gnnjax.guide.view import ArmView, arm_view
from gnnjax.planning.load import load_planner
from gnnjax.scene.scene import make_scene
from gnnjax.training.weights import load_network, save_network


@pytest.fixture(scope="module")
def network():
    return MotionNetwork(num_points=3, channels=8, rngs=nnx.Rngs(0))


def random_view(rng, num=6):
    clearance, points = rng.normal(scale=0.2, size=(num, 4)), rng.normal(size=(num, 3, 3))
    return ArmView(jnp.asarray(clearance, jnp.float32), jnp.asarray(points, jnp.float32))


def test_the_network_agrees_with_numpy_layer_by_layer(network):
    rng = np.random.default_rng(0)
    start, end, length = random_view(rng), random_view(rng), rng.random(6).astype(np.float32)
    expected = []
    for i in range(6):
        near, far = (
            np.array([np.tanh(x.clearance[i] / scale) for scale in (0.05, 0.2)])
            for x in (start, end)
        )
        moved = [np.linalg.norm(start.points[i, p] - end.points[i, p]) for p in range(3)]
        travel = np.array([*moved, 0.3 * length[i]])
        worst = (start.clearance[i] + end.clearance[i] - travel) / 2
        worst = np.array([np.tanh(worst / s) for s in (0.05, 0.2)])
        parts = (near + far).ravel(), np.abs(near - far).ravel(), worst.ravel(), travel, [length[i]]
        x = np.concatenate(parts)
        for layer in (network.first, network.second):
            x = np.maximum(x @ np.asarray(layer.kernel) + np.asarray(layer.bias), 0)
        expected.append(x @ np.asarray(network.out.kernel) + np.asarray(network.out.bias))
    found = network(start, end, jnp.asarray(length))
    np.testing.assert_allclose(found, np.ravel(expected), atol=1e-5)
    assert np.std(expected) > 1e-3


def test_a_motion_and_its_way_back_have_equal_logits(network):
    rng = np.random.default_rng(1)
    start, end = random_view(rng), random_view(rng)
    length = jnp.asarray(rng.random(6), jnp.float32)
    np.testing.assert_array_equal(network(start, end, length), network(end, start, length))


@pytest.fixture(scope="module")
def prices(tiny_path, network):
    view = arm_view(load_robot(tiny_path), 3)
    scene = jax.tree.map(jnp.asarray, make_scene([[0.5, 0, 0.2]], [[0.1, 0.2, 0.1]]))
    prices = make_prices(network, functools.partial(view, scene))
    return Prices(jax.jit(prices.nodes), jax.jit(prices.motions, static_argnums=2))


def test_prices_of_pieces_add_up_along_a_motion(prices):
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(5, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = np.array([0.0, 0.3, 0.9, 1.4, 2.6], np.float32)
    starts = rng.uniform(-0.5, 0.5, (5, 3)).astype(np.float32)
    ends = (starts + lengths[:, None] * directions).astype(np.float32)
    found = prices.motions(starts, ends, 4)
    for i, length in enumerate(lengths):
        # The last has pieces longer than the spacing, since there are but four.
        pieces = min(4, max(1, int(np.ceil(length / SPACING))))
        fraction = np.minimum(np.arange(5) / pieces, 1)[:, None]
        line = (starts[i] + fraction * (ends[i] - starts[i])).astype(np.float32)
        alone = prices.motions(line[:-1], line[1:], 1)[:pieces]
        np.testing.assert_allclose(found[i], alone.sum(), rtol=1e-4)
    assert (np.asarray(found) > 0).all()
    np.testing.assert_allclose(prices.motions(ends, starts, 4), found, rtol=1e-4)
    # A node is a motion without length.
    np.testing.assert_allclose(prices.nodes(starts)[0], found[0], rtol=1e-5)


def test_a_price_is_minus_the_log_of_the_chance_to_be_free(tiny_path, network, prices):
    view = arm_view(load_robot(tiny_path), 3)
    scene = jax.tree.map(jnp.asarray, make_scene([[0.5, 0, 0.2]], [[0.1, 0.2, 0.1]]))
    q = jnp.asarray(np.random.default_rng(3).uniform(-1, 1, (5, 3)), jnp.float32)
    seen = view(scene, q)
    free = 1 / (1 + np.exp(-np.asarray(network(seen, seen, jnp.zeros(5)))))
    np.testing.assert_allclose(prices.nodes(q), -np.log(free), rtol=1e-5)


def test_the_shipped_network_tells_free_motions_from_blocked_ones():
    robot = load_robot("kuka_iiwa14")
    network = load_network("motion")
    assert isinstance(network, MotionNetwork)
    view = arm_view(robot, network.num_points)
    start = np.array([-0.9, 0.9, 0, -1, 0, 0.6, 0], np.float32)
    past = start * np.array([-1, 1, 1, 1, 1, 1, 1], np.float32)
    for box, least, most in (([0.6, 0.0, 0.5], 4.0, np.inf), ([-0.9, 0.0, 0.2], 0.0, 0.2)):
        scene = jax.tree.map(jnp.asarray, make_scene([box], [[0.15, 0.05, 0.5]]))
        prices = make_prices(network, functools.partial(view, scene))
        price = float(jax.jit(prices.motions, static_argnums=2)(start[None], past[None], 8)[0])
        assert least <= price <= most


def test_a_checkpoint_knows_its_kind(network, tmp_path):
    save_network(tmp_path / "weights.safetensors", network, {})
    loaded = load_network(tmp_path / "weights.safetensors")
    assert isinstance(loaded, MotionNetwork)
    assert loaded.config == {"num_points": 3, "channels": 8}
    jax.tree.map(np.testing.assert_array_equal, nnx.state(loaded), nnx.state(network))


@pytest.mark.parametrize(
    ("method", "weights", "message"),
    [
        (
            "guided",
            "kuka_iiwa14",
            "planner 'guided' takes a MotionNetwork, and 'kuka_iiwa14' is a ",
        ),
        ("gnn", "motion", "planner 'gnn' takes a GuidanceNetwork, and 'motion' is a MotionNetwork"),
    ],
)
def test_weights_of_the_other_kind_are_refused(method, weights, message):
    with pytest.raises(InputError, match=message):
        load_planner("kuka_iiwa14", method, weights=weights)
