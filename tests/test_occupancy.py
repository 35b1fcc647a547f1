"""The grid of the paper's network and its convolution, against brute force and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy.ndimage import correlate
from scipy.spatial.transform import Rotation

from gnnjax.paper.occupancy import HalvingConv, occupancy_grid
from tests.draws import boxes_and_padding

LOWER, UPPER = (-1.2, -1.2, -0.4), (1.2, 1.2, 1.6)
drawn = jax.jit(occupancy_grid, static_argnums=(1, 2, 3))


@pytest.mark.parametrize("size", [8, 5, 2])
def test_convolution_agrees_with_scipy(size):
    conv = HalvingConv(2, 3, rngs=nnx.Rngs(0))
    grid = np.random.default_rng(0).normal(size=(size, size, size, 2)).astype(np.float32)
    kernel = np.asarray(conv.linear.kernel[...]).reshape(3, 3, 3, 2, 3)  # z, y, x, in, out
    expected = [
        sum(
            correlate(grid[..., a], kernel[..., a, b].transpose(2, 1, 0), mode="constant")
            for a in range(2)
        )[::2, ::2, ::2]
        for b in range(3)
    ]
    np.testing.assert_allclose(
        jax.jit(conv)(grid), np.stack(expected, axis=-1), rtol=2e-5, atol=2e-5
    )


def test_occupancy_grid_agrees_with_brute_force():
    scene, m = boxes_and_padding(), 6
    low, high = np.array(LOWER), np.array(UPPER)
    expected = np.zeros((m, m, m))
    for index in np.ndindex(m, m, m):
        center = low + (np.array(index) + 0.5) * (high - low) / m
        for b in np.flatnonzero(scene.mask):
            rotation = Rotation.from_quat(scene.quats[b], scalar_first=True)
            local = rotation.inv().apply(center - np.asarray(scene.centers[b]))
            expected[index] += np.all(np.abs(local) <= np.maximum(scene.half_extents[b], 0.2))
    assert 0.02 < np.mean(expected > 0) < 0.9
    np.testing.assert_array_equal(drawn(scene, LOWER, UPPER, m), expected > 0)


def test_a_thin_pillar_between_voxel_centers_is_drawn():
    scene = boxes_and_padding(num_boxes=1, padding=0)._replace(
        centers=jnp.array([[0.0, 0.0, 0.6]]),
        half_extents=jnp.array([[0.01, 0.01, 1.0]]),
        quats=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
    )
    grid = drawn(scene, LOWER, UPPER, 8)
    assert grid.sum() == 2 * 2 * 8  # the pillar stands on an edge that four columns share
