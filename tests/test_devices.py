"""Maps over problems are what `vmap` makes of the same function, traced once."""

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.devices import map_first


def test_the_first_rows_are_mapped_with_one_trace_and_the_others_are_zero():
    traces = []

    @jax.jit
    def mapped(scale, rows, num):
        def function(row):
            traces.append(row)
            a, b = row
            return a @ a * scale, jnp.where(b, a, -a)

        return map_first(function, num, rows)

    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(5, 3)).astype(np.float32), rng.random(5) < 0.5
    for num in (0, 3, 5):
        squares, signed = mapped(2.0, (a, b), num)
        wanted = np.arange(5) < num
        np.testing.assert_allclose(squares, wanted * 2 * (a * a).sum(1), rtol=1e-5)
        np.testing.assert_array_equal(
            signed, np.where(wanted[:, None], np.where(b[:, None], a, -a), 0)
        )
    assert len(traces) == 1
