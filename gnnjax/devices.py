"""How work is compiled and spread: the cache of compiled code, and the axis of many problems."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.errors import InputError
from gnnjax.files import cache_folder


def cache_compilations() -> None:
    """Keeps compiled code in the user's cache folder, unless JAX was already told where."""
    if jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def run_where_called() -> None:
    """Runs compiled functions in the thread that calls them, for many small calls in a row.

    Handing each to another thread doubles the time of a call of 0.1 ms on a busy machine. JAX reads
    this when it makes its first array; later it changes nothing.
    """
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def platform() -> str:
    """Where functions that are called now run: "cpu", "gpu" or "tpu"."""
    device = jax.config.jax_default_device
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


@contextmanager
def in_single_precision() -> Iterator[None]:
    """Has functions be traced as they were written, also where `jax_enable_x64` is set: numbers
    that have no type are of single precision."""
    with jax.enable_x64(False):
        yield


@contextmanager
def on_host() -> Iterator[None]:
    """Has functions run on the CPU, also where JAX has an accelerator, and in single precision.

    For many small calls in a row, as searches make them: an H100 takes half a millisecond or more
    for each, and with all of its calls there a batch of 256 plans took three times as long as on a
    single core.

    Raises:
        InputError: JAX was told to do without its CPU.
    """
    if platform() == "cpu":
        with in_single_precision():
            yield
        return
    try:
        device = jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        raise InputError(
            f"JAX_PLATFORMS is {jax.config.jax_platforms!r}, and searches need the CPU, too; "
            "leave it out, or add ',cpu'"
        ) from None
    with jax.default_device(device), in_single_precision():
        yield


_LEAST_SHARE = 16  # problems; fewer are not worth another thread


class Share(NamedTuple):
    """Problems that one thread plans on one device."""

    device: Any  # of JAX; None: the only one
    numbers: np.ndarray  # [n] of the problems

    def at_home(self) -> AbstractContextManager:
        """Context in which to call jitted functions, so that they are not recompiled for another
        device."""
        return nullcontext() if self.device is None else jax.default_device(self.device)


def shares_of(num: int) -> list[Share]:
    """Divides `num` problems among the devices of the process, or the cores of the only one where
    that is a CPU.
    """
    devices: list[Any] = jax.local_devices(backend=platform())
    if len(devices) == 1:
        # A thread begins without what `on_host` has chosen.
        devices = [jax.config.jax_default_device] * (num_cores() if platform() == "cpu" else 1)
    dealt = deal(num, len(devices), _LEAST_SHARE)
    return [Share(device, numbers) for device, numbers in zip(devices, dealt, strict=False)]


def deal(num: int, most: int, least: int) -> list[np.ndarray]:
    """The numbers of `num` problems, dealt out in turn to as many as get `least` each, but no more
    than `most`."""
    count = max(1, min(most, num // least))
    return [np.arange(i, num, count) for i in range(count)]


def gather(dealt: Sequence[np.ndarray], found: Iterable[Iterable]) -> list:
    """Of what was found for each part of what was dealt out, the results in the order of the
    problems."""
    results: list = [None] * sum(map(len, dealt))
    for numbers, some in zip(dealt, found, strict=True):
        for number, result in zip(numbers, some, strict=True):
            results[number] = result
    return results


def side_by_side(function: Callable[[Share], list], shares: list[Share]) -> list:
    """Calls a function for each of some shares, on its device and, of several, in a thread.

    Args:
        function: of a share, to a result for each of its problems.
        shares: from `shares_of`.

    Returns:
        The results, in the order of the problems.
    """

    def call(share: Share) -> list:
        with share.at_home(), in_single_precision():  # which other threads are not in
            return function(share)

    if len(shares) == 1:
        return call(shares[0])
    with ThreadPoolExecutor(len(shares)) as threads:
        return gather([share.numbers for share in shares], threads.map(call, shares))


def map_first(
    function: Callable,
    num: jax.Array | int,
    args: Any,
    rows: jax.Array | None = None,
    into: Any = None,
) -> Any:
    """Maps `function` over the first `num` rows of `args`, or over the first of `rows`; zeros, or
    what is in `into`, or on an accelerator whatever comes out, elsewhere.

    One row after the other on a CPU, whose cores a single one keeps busy: what is compiled for a
    row, and so each bit of its result, is then the same however many rows there are. Side by side
    on an accelerator.

    Args:
        function: of one row.
        num: how many rows count; an array, or the compiler would unroll a single turn.
        args: a tree of arrays with B rows.
        rows: which rows count.
        into: a tree of results with B rows, which are replaced.
    """
    if platform() != "cpu":
        return jax.vmap(function)(args)
    function = jax.jit(function, inline=True)  # traced once for both uses
    if into is None:
        size = len(jax.tree.leaves(args)[0])
        blank = jax.eval_shape(function, jax.tree.map(lambda x: x[0], args))
        into = jax.tree.map(lambda x: jnp.zeros((size, *x.shape), x.dtype), blank)

    def one(i: jax.Array, results: Any) -> Any:
        row = i if rows is None else rows[i]
        result = function(jax.tree.map(lambda x: x[row], args))
        return jax.tree.map(lambda x, y: x.at[row].set(y), results, result)

    return jax.lax.fori_loop(0, num, one, into)


def marked_first(marked: np.ndarray) -> tuple[np.ndarray, np.int32]:
    """The `rows` and `num` that `map_first` takes for the marked ones of B rows.

    Args:
        marked: `[B]` bool.

    Returns:
        `[B]` the numbers of those that are marked, padded; and how many they are.
    """
    chosen = np.flatnonzero(marked)
    return np.pad(chosen, (0, len(marked) - len(chosen))).astype(np.int32), np.int32(len(chosen))


def num_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def on_all_cores(function: Callable, args: Any) -> Any:
    """Calls a compiled `(num, args) -> results`, which is a `map_first`, for all rows of `args`.

    On a CPU each core takes a part of the rows: `map_first` keeps but one of them busy. An
    accelerator takes them at once.

    Args:
        function: jitted; its results are a tree of arrays.
        args: a tree of arrays with B rows.

    Returns:
        NumPy arrays with B rows.
    """
    num = len(jax.tree.leaves(args)[0])
    on_cpu = platform() == "cpu"
    cores = min(num, num_cores()) if on_cpu else 1
    size = -(-num // cores)
    # Compiled for one of few sizes; on a CPU, rows that do not count take no time.
    room = 16 if on_cpu else size
    while room < size:
        room *= 4

    home = jax.config.jax_default_device  # which threads do not know

    def part(first: int, count: int) -> Any:
        rows = np.minimum(np.arange(first, first + room), num - 1)
        with jax.default_device(home):
            found = function(np.int32(count), jax.tree.map(lambda x: x[rows], args))
            return jax.tree.map(lambda x: np.asarray(x)[:count], found)

    if cores > 1:  # or each thread would compile it
        part(0, 0)
    with ThreadPoolExecutor(cores) as pool:
        firsts = range(0, num, size)
        parts = list(pool.map(part, firsts, (min(size, num - first) for first in firsts)))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
