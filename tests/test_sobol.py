"""Sobol points against SciPy's."""

import numpy as np
import pytest
from scipy.stats import qmc

from gnnjax.errors import InputError
from gnnjax.roadmap.sobol import MOST_DIMS, sobol_points


@pytest.mark.parametrize("num_dims", [1, 3, 7, MOST_DIMS])
@pytest.mark.parametrize("seed", [0, 5003])
def test_points_are_those_of_scipy_block_by_block(num_dims, seed):
    theirs = qmc.Sobol(num_dims, rng=np.random.default_rng(seed))
    for first in (0, 256):
        np.testing.assert_array_equal(sobol_points(num_dims, seed, first, 256), theirs.random(256))


def test_more_dimensions_than_known_are_refused():
    with pytest.raises(InputError, match="33 joints; roadmaps of at most 32"):
        sobol_points(MOST_DIMS + 1, 0, 0, 1)
