"""Functions of components are what `vmap` makes of the same functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.collision.components import in_components


def components(batch, shape):
    """An array `[B *shape]` as components that are arrays `[B]`."""
    entries = np.empty(shape, object)
    for index in np.ndindex(*shape):
        entries[index] = batch[(slice(None), *index)]
    return entries


def nearest_corner(points, q):
    """Products, reductions, a choice that depends on the data, and constants."""
    scale = jnp.array([[1.0, 0.0, 0.5], [0.0, 2.0, 0.0]]) @ q
    squared = jnp.sum(jnp.square(points - q), axis=1)
    best, worst = jnp.argmin(squared), jnp.argmax(squared)
    inside = jnp.all(jnp.abs(points[best]) < 1) | jnp.any(points[worst] > 1.5)
    other = jnp.where(inside, points[best], points[worst] / jnp.sqrt(1 + squared[worst]))
    swapped = jnp.concatenate([other[1:], -other[:1]])
    return jnp.outer(scale, jnp.cross(swapped, q)) + jnp.arange(3.0) * jnp.max(squared)


def test_components_are_what_vmap_computes():
    rng = np.random.default_rng(0)
    shapes = (4, 3), (3,)
    batches = [jnp.asarray(rng.normal(size=(64, *s)), jnp.float32) for s in shapes]
    expected = jax.vmap(nearest_corner)(*batches)
    run = in_components(nearest_corner, shapes)

    @jax.jit
    def mapped(*batches):
        found = run(*map(components, batches, shapes))
        return jnp.stack([jnp.stack(list(row), -1) for row in found], -2)

    np.testing.assert_allclose(mapped(*batches), expected, rtol=1e-4, atol=1e-5)


def test_numbers_and_batches_mix():
    run = in_components(lambda matrix, x: (matrix @ x)[0], [(2, 2), (2,)])
    identity = np.array([[1.0, 0.0], [0.0, 1.0]], object)
    x = components(jnp.arange(6.0).reshape(3, 2), (2,))
    # Zeros and ones leave nothing to compute.
    assert run(identity, x).item() is x[0]
    assert run(identity, np.array([3.0, 4.0], object)).item() == 3.0


def test_what_has_no_rule_is_refused():
    with pytest.raises(NotImplementedError, match="no rule for the operation 'sort'"):
        in_components(jnp.sort, [(3,)])
    # Where nothing depends on it, it does not matter.
    in_components(lambda x: (jnp.sort(x), x)[1], [(3,)])
