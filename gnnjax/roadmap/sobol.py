"""Scrambled Sobol sequences: points that fill a cube evenly, more so than random ones.

The same points as `scipy.stats.qmc.Sobol(num_dims, rng=np.random.default_rng(seed))`, which the
tests hold them to; that module alone takes longer to import than everything else here.
"""

import numpy as np

from gnnjax.errors import InputError

_BITS = 30

# Of each dimension after the first: a primitive polynomial over GF(2), its coefficients as bits,
# and the initial direction numbers. Joe and Kuo (2008), "Constructing Sobol sequences with better
# two-dimensional projections", table new-joe-kuo-6.
# fmt: off
_DIRECTIONS = (
    (3, (1,)), (7, (1, 3)), (11, (1, 3, 1)), (13, (1, 1, 1)), (19, (1, 1, 3, 3)),
    (25, (1, 3, 5, 13)), (37, (1, 1, 5, 5, 17)), (41, (1, 1, 5, 5, 5)), (47, (1, 1, 7, 11, 19)),
    (55, (1, 1, 5, 1, 1)), (59, (1, 1, 1, 3, 11)), (61, (1, 3, 5, 5, 31)),
    (67, (1, 3, 3, 9, 7, 49)), (91, (1, 1, 1, 15, 21, 21)), (97, (1, 3, 1, 13, 27, 49)),
    (103, (1, 1, 1, 15, 7, 5)), (109, (1, 3, 1, 15, 13, 25)), (115, (1, 1, 5, 5, 19, 61)),
    (131, (1, 3, 7, 11, 23, 15, 103)), (137, (1, 3, 7, 13, 13, 15, 69)),
    (143, (1, 1, 3, 13, 7, 35, 63)), (145, (1, 3, 5, 9, 1, 25, 53)),
    (157, (1, 3, 1, 13, 9, 35, 107)), (167, (1, 3, 1, 5, 27, 61, 31)),
    (171, (1, 1, 5, 11, 19, 41, 61)), (185, (1, 3, 5, 3, 3, 13, 69)),
    (191, (1, 1, 7, 13, 1, 19, 1)), (193, (1, 3, 7, 5, 13, 19, 59)),
    (203, (1, 1, 3, 9, 25, 29, 41)), (211, (1, 3, 5, 13, 23, 1, 55)),
    (213, (1, 3, 7, 3, 13, 59, 17)),
)
# fmt: on
MOST_DIMS = len(_DIRECTIONS) + 1


def sobol_points(num_dims: int, seed: int, first: int, num: int) -> np.ndarray:
    """Points `first` to `first + num` of a sequence, `[num, num_dims]` in the unit cube.

    Scrambled by random lower triangular matrices and a random shift (Matousek, 1998).

    Raises:
        InputError: more dimensions than there are direction numbers for.
    """
    if num_dims > MOST_DIMS:
        raise InputError(
            f"{num_dims} joints; roadmaps of at most {MOST_DIMS} are supported, hold some of them"
        )
    rng = np.random.default_rng(seed).spawn(1)[0]
    power = np.arange(_BITS, dtype=np.uint64)
    shift = (rng.integers(2, size=(num_dims, _BITS), dtype=np.uint32) << power).sum(axis=1)
    matrices = np.tril(rng.integers(2, size=(num_dims, _BITS, _BITS), dtype=np.uint32))
    matrices[:, power, power] = 1
    # Bits of the direction numbers, the highest first, times the matrices over GF(2).
    bits = (_direction_numbers(num_dims)[:, :, None] >> power[::-1]) & 1  # [D j k]
    bits = np.einsum("dpk,djk->djp", matrices.astype(np.uint64), bits) & 1
    numbers = (bits << power[::-1]).sum(axis=2)  # [D j]
    # Point n is the sum over GF(2) of the numbers whose bits its Gray code has.
    index = np.arange(first, first + num, dtype=np.uint64)
    gray = index ^ (index >> np.uint64(1))
    points = np.broadcast_to(shift, (num, num_dims)).copy()
    for j in range(_BITS):
        points ^= ((gray[:, None] >> power[j]) & np.uint64(1)) * numbers[:, j]
    return points / 2.0**_BITS


def _direction_numbers(num_dims: int) -> np.ndarray:
    """`[D, bits]`, by the recurrence of the primitive polynomials (Bratley and Fox, 1988)."""
    numbers = np.ones((num_dims, _BITS), np.uint64)
    for row, (polynomial, initial) in zip(numbers[1:], _DIRECTIONS, strict=False):
        degree = polynomial.bit_length() - 1
        values = list(initial)
        for j in range(degree, _BITS):
            new = values[j - degree]
            for k in range(degree):
                if (polynomial >> (degree - 1 - k)) & 1:
                    new ^= values[j - k - 1] << (k + 1)
            values.append(new)
        row[:] = values
    return numbers << np.arange(_BITS - 1, -1, -1, dtype=np.uint64)
