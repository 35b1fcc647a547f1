"""A clock that stands still while something is compiled."""

import time
from typing import Any

import jax


class Clock:
    """Seconds of planning."""

    def __init__(self):
        self._waited = 0.0

    def now(self) -> float:
        """The time."""
        return time.perf_counter() - self._waited

    def call(self, function: Any, *args: Any) -> Any:
        """Calls a jitted function; a call that compiles it takes no time."""
        before, known = time.perf_counter(), function._cache_size()
        result = function(*args)
        if function._cache_size() > known:
            jax.block_until_ready(result)
            self._waited += time.perf_counter() - before
        return result

    def remembered(self, function: Any, *args: Any) -> Any:
        """Calls a function with a cache; what it makes but once takes no time."""
        before, misses = time.perf_counter(), function.cache_info().misses
        result = function(*args)
        if function.cache_info().misses > misses:
            self._waited += time.perf_counter() - before
        return result
