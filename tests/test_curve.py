"""Curves of rounded paths: their grids have all corners, and what is cut out is where it was."""

import jax
import numpy as np

from gnnjax.trajectory.curve import cut, edges_of, make_curve, places, size_of, thirds


def test_what_is_cut_out_of_a_curve_is_where_it_was():
    rng = np.random.default_rng(0)
    path = rng.normal(size=(12, 3))
    half = 0.4 * edges_of(path)[0]
    blends = np.minimum(half[:-1], half[1:]) * (np.arange(10) % 4 > 0)
    curve = make_curve(path, blends, size_of(path))
    ends = np.flatnonzero(curve.stops).tolist()
    for first, last in zip(ends[::2], ends[1::2], strict=True):
        own = cut(curve, first, last)
        assert len(own.grid) <= len(curve.grid)
        at = np.linspace(0, last - first, 500)
        at[-1] -= 1e-9  # behind it, a stop turns
        for part, whole in zip(places(own, at), places(curve, first + at), strict=True):
            np.testing.assert_allclose(part, whole, atol=1e-9)
        np.testing.assert_allclose(thirds(own, at), thirds(curve, first + at), atol=1e-6)
        np.testing.assert_allclose(own.grid[-1], curve.grid[last] - curve.grid[first])


def test_the_grid_of_a_curve_has_all_its_corners():
    rng = np.random.default_rng(0)
    for number in range(2, 12):
        path = rng.normal(size=(number, 3))
        half = edges_of(path)[0] / 2
        blends = np.minimum(half[:-1], half[1:]) * rng.integers(0, 2, number - 2)
        curve = make_curve(path, blends, size_of(path))
        assert (np.diff(curve.grid) >= 0).all()
        for corner, blend in enumerate(blends):
            ends = curve.grid[[curve.entries[corner], curve.exits[corner]]]
            np.testing.assert_allclose(ends, curve.corners[corner] + [-blend, blend], atol=1e-9)
            assert curve.stops[curve.entries[corner]] == (blend == 0)
        # Its derivatives are those of its positions.
        at = np.linspace(0.01, len(curve.grid) - 1.01, 200)
        assert isinstance(jax.tree.leaves(places(curve, at))[0], np.ndarray)
        np.testing.assert_allclose(places(curve, at[:1] * 0).q[0], path[0])
        np.testing.assert_allclose(
            places(curve, np.array([len(curve.grid) - 1.0])).q[0], path[-1], atol=1e-12
        )
