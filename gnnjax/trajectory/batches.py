"""Curves worked on one after the other, or those of a size at once, as the machine likes it."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from gnnjax.clock import Clock
from gnnjax.devices import platform


def over_curves(
    alone: Callable[..., Any],
    together: Callable[..., Any],
    limits: Any,
    rows: Sequence[Any],
    sizes: Sequence[int],
    clock: Clock,
) -> list[Any]:
    """What a function finds of each row, in NumPy's arrays of double precision.

    Args:
        alone: jitted, `(limits, row)`.
        together: the same for rows that are stacked.
        limits: the same for all.
        rows: trees of arrays.
        sizes: by which rows can be stacked.
        clock: that stands still while something is compiled.
    """
    found: list[Any] = [None] * len(rows)
    with jax.enable_x64(True):
        if platform() == "cpu":  # whose caches hold what is computed of one row
            found = [clock.call(alone, limits, row) for row in rows]
        else:
            for size in {*sizes}:
                own = [i for i, other in enumerate(sizes) if other == size]
                padded = 1
                while padded < len(own):  # so that few numbers are compiled
                    padded *= 2
                chosen = [rows[i] for i in own + own[:1] * (padded - len(own))]
                stacked = jax.tree.map(lambda *x: np.stack(x), *chosen)
                results = clock.call(together, limits, stacked)
                for number, i in enumerate(own):
                    found[i] = jax.tree.map(lambda x, n=number: x[n], results)
    return jax.tree.map(np.asarray, found)
