"""What methods keep: with their object, which is freed with all of it.

`functools.cache` and `jax.jit` of a method itself keep every object it was ever called on.
"""

import functools
from collections.abc import Callable
from typing import Any


def per_object(wrap: Callable[[Callable], Any]) -> Callable[[Callable], Any]:
    """Decorates a method: each object has its own, made by `wrap` when it is first asked for.

    Args:
        wrap: such as `jax.jit` or `functools.cache`; arguments that it counts are those behind
            `self`.
    """

    def decorate(method: Callable) -> functools.cached_property:
        return functools.cached_property(lambda self: wrap(method.__get__(self)))

    return decorate
