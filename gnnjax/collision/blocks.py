"""Rows of arrays in blocks of a few sizes, for each of which a function is compiled once."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np


def in_blocks(
    function: Callable[..., jax.Array], blocks: tuple[int, ...], *rows: np.ndarray
) -> np.ndarray:
    """What a function says of rows, asked in blocks of a few sizes; what is missing is zero."""
    parts, begin, num = [], 0, len(rows[0])
    while begin < num:
        left = num - begin
        block = next((b for b in blocks if left <= b), blocks[-1])
        # Two calls of the middle size are less work than one that is mostly padding.
        while block > blocks[0] and left <= block // 4:
            block = blocks[blocks.index(block) - 1]
        end = min(begin + block, num)
        parts.append((end - begin, function(*(_filled(x[begin:end], block) for x in rows))))
        begin = end
    # All are on their way before the first is waited for.
    return np.concatenate([np.asarray(found)[:num] for num, found in parts])


class Runs(NamedTuple):
    """Runs of equal numbers, R."""

    number: np.ndarray  # [R]
    begin: np.ndarray  # [R] where each begins
    size: np.ndarray  # [R]


def runs_of(numbers: np.ndarray) -> Runs:
    """The runs of equal numbers that lie side by side."""
    is_first = np.ones(len(numbers) + 1, bool)
    np.not_equal(numbers[1:], numbers[:-1], out=is_first[1:-1])
    bounds = is_first.nonzero()[0]  # and where the last ends
    begin = bounds[:-1]
    return Runs(numbers[begin], begin, bounds[1:] - begin)


def _filled(array: np.ndarray, num: int) -> np.ndarray:
    """With zeros at the end, up to a number of rows."""
    if len(array) == num:
        return array
    filled = np.zeros((num, *array.shape[1:]), array.dtype)
    filled[: len(array)] = array
    return filled
