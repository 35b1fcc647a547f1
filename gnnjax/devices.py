"""How work is compiled and spread: the cache of compiled code, and the axis of many problems."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp


def cache_compilations() -> None:
    """Keeps compiled code in the user's cache folder, unless JAX was already told where."""
    if jax.config.jax_compilation_cache_dir is None:
        folder = Path.home() / ".cache" / "gnnjax" / "jax"
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def run_where_called() -> None:
    """Runs compiled functions in the thread that calls them, for many small calls in a row.

    Handing each to another thread doubles the time of a call of 0.1 ms on a busy machine. JAX reads
    this when it makes its first array; later it changes nothing.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def over_problems(function: Callable, active: jax.Array, *args):
    """Maps `function` over the leading axis of `args`; zeros where not `active`.

    One problem after the other on a CPU, whose cores a single problem keeps busy; side by side on
    an accelerator.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function)(*args)
    blank = jax.eval_shape(function, *jax.tree.map(lambda x: x[0], args))

    def one(turn):
        wanted, *own = turn
        return jax.lax.cond(
            wanted,
            lambda: function(*own),
            lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), blank),
        )

    return jax.lax.map(one, (active, *args))


def map_first(function: Callable, num: jax.Array | int, args: Any) -> Any:
    """Maps `function` over the first `num` rows of `args`; zeros beyond.

    One row after the other on a CPU, whose cores a single one keeps busy: what is compiled for a
    row, and so each bit of its result, is then the same however many rows there are. Side by side
    on an accelerator.

    Args:
        function: of one row.
        num: how many rows count; an array, or the compiler would unroll a single turn.
        args: a tree of arrays with B rows.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function)(args)
    function = jax.jit(function, inline=True)  # traced once for both uses
    size = len(jax.tree.leaves(args)[0])
    blank = jax.eval_shape(function, jax.tree.map(lambda x: x[0], args))

    def one(i: jax.Array, results: Any) -> Any:
        result = function(jax.tree.map(lambda x: x[i], args))
        return jax.tree.map(lambda x, y: x.at[i].set(y), results, result)

    zeros = jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), blank)
    return jax.lax.fori_loop(0, num, one, zeros)
