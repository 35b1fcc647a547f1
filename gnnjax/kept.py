"""Compiled functions that are kept whole, so that the next process neither traces nor lowers them.

JAX keeps what it has compiled by the program that was lowered, and to trace and lower that takes a
new process longer than to read the code. Here it is found by all that the program depends on: the
digest of the function with all that it reaches (`digest.py`), the shapes of its arguments, the
sources of the package, versions, settings and the processor (`surroundings.py`). Of a wrong key
would come another arm's collision kernel; so what has no complete digest is not kept, but compiled
as ever.

Such a key names a link, and that the program, by which code is kept: where sources have changed and
the program has not, it is traced and lowered, and not compiled.
"""

import contextlib
import functools
import hashlib
import logging
import os
import pickle
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from gnnjax.digest import Undigested, digest
from gnnjax.errors import InputError
from gnnjax.files import atomic_write, cache_folder
from gnnjax.memory_maps import Room
from gnnjax.notice import told_if_long
from gnnjax.surroundings import SOURCES, keeps_code, machine, settings

_LOG = logging.getLogger(__name__)
_MOST_BYTES = 1 << 30  # of all files; those that were not read for longest go first
_FIRST = (
    "gnnjax: compiling for a first use of this kind, which may take a minute or more; "
    "later ones find the code in {}"
)
_CHECK = "GNNJAX_CHECK_KEPT"  # in the environment: lower all the same, and compare
# Settings of JAX that a function called in another context is compiled anew for.
_CONTEXT = (
    "jax_enable_x64",
    "jax_default_device",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
)
_LOCK = threading.RLock()  # of finding code, or each thread would compile it
_ROOM = Room()


class Kept:
    """A function, and what was compiled for each shape of its arguments."""

    def __init__(self, function: Callable, donate_argnums: tuple[int, ...] = ()):
        self.function, self.donate_argnums = function, donate_argnums
        self.name = getattr(function, "__qualname__", repr(function))
        self._jitted = jax.jit(function, donate_argnums=donate_argnums)
        self._found: dict[Any, Callable] = {}

    def __getstate__(self) -> dict[str, Any]:
        """What it depends on, for the digest of what calls it."""
        return {"function": self.function, "donate_argnums": self.donate_argnums}

    def __call__(self, *args: Any) -> Any:
        return self.code_for(*args)(*args)

    def code_for(self, *args: Any) -> Callable:
        """What computes arguments of these shapes, for many small calls: it does not look again."""
        leaves, tree = jax.tree.flatten(args)
        context = (getattr(jax.config, name) for name in _CONTEXT)
        shapes = tree, *context, *map(_outline, leaves)
        found = self._found.get(shapes)
        if found is None:
            with _LOCK:
                found = self._found.get(shapes)
                if found is None:
                    found = self._found[shapes] = self._find(tree, leaves, args)
        return found

    def _cache_size(self) -> int:
        """For how many shapes it was compiled, as JAX calls it."""
        return len(self._found)

    def _find(self, tree: Any, leaves: list[Any], args: tuple) -> Callable:
        """What computes arguments of these shapes."""
        _ROOM.make()
        kinds = [_kind(leaf) for leaf in leaves]
        if None in kinds or not keeps_code():
            return self._jitted
        shape = str(tree), [(shape, dtype.name, weak) for shape, dtype, weak in kinds]
        where = self.donate_argnums, shape, machine(), settings()
        try:
            key = digest(self.function, SOURCES, *where)
            folder = cache_folder("code")
            link = folder / f"{key}.link"
            named = _read(link)
            code = None if named is None else _load(folder / f"{named.decode()}.code")
            if code is not None and not os.environ.get(_CHECK):
                return code
            _LOG.info("compiling %s", self.name)
            begin = time.monotonic()
            with told_if_long(_FIRST.format(folder.parent)):
                lowered = self._jitted.lower(*args)
                # Code holds the form of its results, too, of which the program tells nothing.
                program = digest(lowered.as_text(), str(lowered.out_tree), *where)
                if code is not None:
                    _check(named, program, self.name)
                    return code
                path = folder / f"{program}.code"
                code = _load(path)
                if code is None:
                    code = _compile(lowered)
                    _write(path, _serialized(code))
            _LOG.info("%s is ready after %.1f s", self.name, time.monotonic() - begin)
            # Nothing that it depends on has been changed in the meantime.
            if digest(self.function, SOURCES, *where) == key:
                _write(link, program.encode())
            return code
        except Undigested as reason:
            _LOG.debug("%s is not kept, as it depends on %s", self.name, reason)
            return self._jitted


def keep(function: Callable, donate_argnums: tuple[int, ...] = ()) -> Kept:
    """`jax.jit` of a function of arrays, whose compiled code is kept on disk.

    Args:
        function: of trees of arrays, by position; it is pure, and so is all that it is made of.
        donate_argnums: as of `jax.jit`.
    """
    return Kept(function, donate_argnums)


def kept_result(function: Callable, *args: Any) -> Any:
    """What a pure function on the host returns, such as NumPy arrays; kept like compiled code."""
    try:
        key = digest(function, SOURCES, machine(), args) if keeps_code() else None
    except Undigested:
        key = None
    if key is None:
        return function(*args)
    path = cache_folder("code") / f"{key}.result"
    content = _read(path)
    if content is not None:
        return pickle.loads(content)
    result = function(*args)
    _write(path, pickle.dumps(result))
    return result


def _outline(leaf: Any) -> Any:
    """What tells arguments that code fits from others, found out in a third of a microsecond."""
    kind = type(leaf)
    if kind is np.ndarray:
        return leaf.shape, leaf.dtype
    return kind, leaf.aval if isinstance(leaf, jax.Array) else getattr(leaf, "dtype", None)


def _kind(leaf: Any) -> Any:
    """Shape, type, and whether its type is weak; None for what is no array, or traced."""
    if isinstance(leaf, jax.Array):
        if isinstance(leaf, jax.core.Tracer) or not isinstance(leaf.dtype, np.dtype):
            return None
        return leaf.shape, leaf.dtype, leaf.weak_type
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.shape, leaf.dtype, False
    return None


def _compile(lowered: Any) -> Any:
    """Compiles without JAX's cache: code that comes out of there cannot be kept again."""
    try:
        jax.config.update("jax_enable_compilation_cache", False)
        reset_cache()  # or it would not look
        return lowered.compile()
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
        reset_cache()


def _serialized(code: Any) -> bytes | None:
    """Code as a file holds it; None where it cannot be loaded again."""
    try:
        content = pickle.dumps(serialize_executable.serialize(code))
        serialize_executable.deserialize_and_load(*pickle.loads(content))
    except Exception as error:  # whatever JAX cannot do with it
        _LOG.debug("compiled code cannot be kept: %s", error)
        return None
    return content


def _load(path: Path) -> Any:
    """Kept code; None where there is none that can be loaded.

    It is machine code, like what JAX keeps beside it: who may write to the folder is trusted.
    """
    content = _read(path)
    if content is None:
        return None
    try:
        return serialize_executable.deserialize_and_load(*pickle.loads(content))
    except Exception as error:  # nearly anything
        return _say_once(f"{str(path)!r} cannot be loaded and is made anew: {error}")


def _check(named: bytes | None, program: str, name: str) -> None:
    """Compares the program that was kept with what was lowered."""
    if named != program.encode():
        raise RuntimeError(
            f"the code that is kept of {name} is another program's; delete "
            f"{str(cache_folder('code'))!r}, and report it"
        )


def _sealed(name: str, content: bytes) -> bytes:
    """What tells a file that is whole, and called as it was written, from others."""
    return hashlib.sha256(name.encode() + b"\n" + content).digest()


def _read(path: Path) -> bytes | None:
    """What was written; None where there is nothing, or it is damaged, which is said once."""
    try:
        whole = path.read_bytes()
        os.utime(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        return _say_once(f"{str(path)!r} cannot be read and is made anew: {error}")
    size = hashlib.sha256().digest_size
    if whole[:size] != _sealed(path.name, whole[size:]):
        return _say_once(f"{str(path)!r} is damaged and is made anew")
    return whole[size:]


def _write(path: Path, content: bytes | None) -> None:
    if content is None:
        return
    try:
        atomic_write(path, lambda part: part.write_bytes(_sealed(path.name, content) + content))
        _make_room(path)
    except (OSError, InputError) as error:
        _say_once(f"what was compiled is not kept: {error}")


def _make_room(newest: Path) -> None:
    """Removes files that were not read for longest, until the others are few enough.

    Clocks of machines that share the folder may differ. So time is told by the file just written,
    and one from the future, which would never go, is as old as it is far from there.
    """
    found = []
    for path in newest.parent.iterdir():
        with contextlib.suppress(OSError):  # another process has just removed it
            known = path.stat()
            found.append((known.st_mtime, known.st_size, path))
    now = next((at for at, _, path in found if path == newest), 0.0)
    left = sum(size for _, size, _ in found)
    for _, size, path in sorted((-abs(now - at), size, path) for at, size, path in found):
        if left <= _MOST_BYTES:
            return
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        left -= size


@functools.cache
def _say_once(message: str) -> None:
    _LOG.warning("%s", message)
