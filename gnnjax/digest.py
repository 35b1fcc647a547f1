"""What a function depends on, as one number: its code, what it is closed over, and so on down.

Two functions with the same digest compute the same. So the digest of everything that can be reached
from a function is taken: the bytecode of functions of this package, as it is loaded, with their
closures, defaults, and the globals that they name; of objects their class and what they hold; of
arrays every bit. What belongs to Python, JAX or NumPy stands for itself by its name, and their
versions have to be told apart elsewhere. What is none of these has no digest, and neither has
anything that it can be reached from.
"""

import enum
import functools
import hashlib
import importlib
import logging
import re
import reprlib
import struct
import sys
import threading
import types
import typing
from collections.abc import Callable, Iterable
from pathlib import Path, PurePath
from typing import Any

import jax
import mujoco
import numpy as np

_PACKAGE = __name__.partition(".")[0]
_FOLDER = Path(__file__).parent

# What stands for itself by its name.
_KNOWN = {
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "mujoco",
    "jaxtyping",
    "ml_dtypes",
} | sys.stdlib_module_names
_JITTED = type(jax.jit(lambda: None))
_WRAPPERS = (_JITTED, type(functools.cache(lambda: None)))
_ENUMS = tuple(x for x in vars(mujoco).values() if hasattr(x, "__members__"))
# What tells nothing of a result: messages, and whose turn it is.
_ASIDE = (logging.Logger, reprlib.Repr, type(threading.Lock()), type(threading.RLock()))
_TYPING = (
    types.GenericAlias,
    types.UnionType,
    typing.TypeVar,
    type(typing.Any),
    type(typing.Callable),
    type(typing.Callable[[], None]),
    type(typing.Literal[0]),
    type(typing.Optional[int]),
)


_FIELD = type(typing.NamedTuple("_One", [("one", int)]).one)  # what a field of one is


class Undigested(Exception):
    """Something that has no digest."""


def sources_digest(folder: Path = _FOLDER) -> str:
    """The digest of all Python files of a folder and those in it, with their names."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        text = path.read_bytes()
        found.update(f"{path.relative_to(folder).as_posix()}:{len(text)}:".encode() + text)
    return found.hexdigest()


def digest(*values: Any) -> str:
    """The digest of some values.

    Raises:
        Undigested: they hold something that has none; it says what.
    """
    walk = _Walk()
    try:
        for value in values:
            walk.add(value)
    except RecursionError:
        raise Undigested("what lies too deep") from None
    return walk.found.hexdigest()


class _Walk:
    """One walk through all that can be reached; what was met before is only referred to."""

    def __init__(self):
        self.found = hashlib.sha256()
        self.seen: dict[int, int] = {}
        self.inside: set[int] = set()  # modules whose globals are being looked up
        self.alive: list[Any] = []  # as long as they are, nothing else has their id

    def add(self, value: Any) -> None:
        """Goes on to a value."""
        if value is None or isinstance(value, bool | int | complex | str | bytes):
            if type(value).__module__ == "builtins":
                return self.note(type(value).__name__, repr(value).encode())
        if type(value) is float:
            return self.note("float", struct.pack("<d", value))
        if value in (Ellipsis, NotImplemented) if type(value) in _CONSTANTS else False:
            return self.note("constant", repr(value).encode())
        if isinstance(value, types.ModuleType):
            return self.note("module", value.__name__.encode())
        if id(value) in self.seen:
            return self.note("again", str(self.seen[id(value)]).encode())
        self.seen[id(value)] = len(self.seen)
        self.alive.append(value)
        self._add_new(value)

    def note(self, kind: str, content: bytes = b"") -> None:
        """Takes down one fact; no two sequences of facts read the same."""
        self.found.update(f"{kind}:{len(content)}:".encode() + content)

    def add_all(self, kind: str, values: Iterable[Any]) -> None:
        values = list(values)
        self.note(kind, str(len(values)).encode())
        for value in values:
            self.add(value)

    def _add_new(self, value: Any) -> None:
        kind = type(value)
        if isinstance(value, jax.core.Tracer):
            raise Undigested("a tracer")
        if _is_known(value):
            return self.note("known", f"{value.__module__}.{value.__qualname__}".encode())
        if isinstance(value, np.ufunc):
            return self.note("ufunc", value.__name__.encode())
        for types_, add in self._RULES:
            if isinstance(value, types_):
                return add(self, value)
        if kind in (list, tuple, dict, types.MappingProxyType):
            items = value if kind in (list, tuple) else [x for two in value.items() for x in two]
            return self.add_all(kind.__name__, items)
        if kind in (set, frozenset):
            return self.add_all(kind.__name__, sorted(map(digest, value)))
        if kind is range or kind is slice:
            return self.note(kind.__name__, repr(value).encode())
        if _of_package(kind.__module__):
            return self._object(value)
        raise Undigested(f"an object of {kind.__module__}.{kind.__qualname__}")

    def _array(self, value: Any) -> None:
        kind = type(value).__name__
        if isinstance(value, jax.Array):
            kind = f"jax {value.weak_type}"
            if not isinstance(value.dtype, np.dtype):
                raise Undigested(f"an array of {value.dtype}")
        value = np.asarray(value)
        if value.dtype.hasobject or value.dtype.fields:
            raise Undigested(f"an array of {value.dtype}")
        self.note("array", f"{kind} {value.dtype.name} {value.dtype.str} {value.shape}".encode())
        self.note("bytes", value.tobytes())

    def _function(self, value: types.FunctionType) -> None:
        module = value.__globals__.get("__name__", "")
        root = module.partition(".")[0]
        if root == "jaxtyping" and hasattr(value, "__wrapped__"):  # checks types, and calls it
            return self.add(value.__wrapped__)
        own = _of_package(module)
        if not own and root not in _KNOWN:
            raise Undigested(f"the function {module}.{value.__qualname__}")
        self.note("function", f"{module}.{value.__qualname__}".encode())
        self._code(value.__code__)
        self.add_all("defaults", [value.__defaults__, value.__kwdefaults__])
        for name, cell in zip(value.__code__.co_freevars, value.__closure__ or (), strict=True):
            self.note("cell", name.encode())
            try:
                content = cell.cell_contents
            except ValueError:  # empty
                continue
            self.add(content)
        if own:
            self._globals(value.__globals__, _names(value.__code__))

    def _code(self, code: types.CodeType) -> None:
        self.note("bytecode", code.co_code)
        self.note("flags", f"{code.co_flags} {code.co_argcount} {code.co_posonlyargcount}".encode())
        self.note("exceptions", code.co_exceptiontable + str(code.co_kwonlyargcount).encode())
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        self.note("names", repr(names).encode())
        self.note("constants", str(len(code.co_consts)).encode())
        for value in code.co_consts:
            if isinstance(value, types.CodeType):
                self._code(value)
            else:
                self.add(value)

    def _globals(self, space: dict[str, Any], names: set[str]) -> None:
        """The globals of these names; of modules of the package, what has one of them, too."""
        for name in sorted(names):
            if name in space:
                self.note("global", name.encode())
                value = space[name]
            elif _of_package(name):  # imported inside of a function
                value = importlib.import_module(name)
            else:
                continue
            self.add(value)
            if isinstance(value, types.ModuleType) and _of_package(value.__name__):
                if id(value) not in self.inside:  # its own names may lead back to it
                    self.inside.add(id(value))
                    self._globals(vars(value), names)
                    self.inside.remove(id(value))

    def _class(self, value: type) -> None:
        name = f"{value.__module__}.{value.__qualname__}"
        if value.__module__.partition(".")[0] in _KNOWN and "<locals>" not in name:
            return self.note("known", f"{name} {value!r}".encode())
        if not _of_package(value.__module__):
            raise Undigested(f"the class {name}")
        self.note("class", name.encode())
        self.add_all("bases", value.__bases__)
        for name, content in vars(value).items():
            if name not in _LEFT_OUT and not _is_generated(content):
                self.note("attribute", name.encode())
                self.add(content)

    def _object(self, value: Any) -> None:
        """An object of the package: its class, and what it holds but for what it has derived."""
        kind = type(value)
        self.add(kind)
        if isinstance(value, tuple):
            self.add_all("fields", value)
        state = value.__getstate__()
        if state is None:
            return
        if not isinstance(state, dict):
            raise Undigested(f"an object of {kind.__module__}.{kind.__qualname__}")
        for name in sorted(state):
            if not isinstance(getattr(kind, name, None), functools.cached_property):
                self.note("attribute", name.encode())
                self.add(state[name])

    def _model(self, value: mujoco.MjModel) -> None:
        content = np.zeros(mujoco.mj_sizeModel(value), np.uint8)
        mujoco.mj_saveModel(value, None, content)
        self.note("model", content.tobytes())

    _RULES: tuple[tuple[Any, Callable[["_Walk", Any], None]], ...] = (
        (np.ndarray | np.generic | jax.Array, _array),
        (np.dtype, lambda self, value: self.note("dtype", f"{value.str}{value.name}".encode())),
        # MuJoCo's have no common class.
        ((enum.Enum, *_ENUMS), lambda self, value: self.add_all("enum", [type(value), value.name])),
        (PurePath, lambda self, value: self.note("path", str(value).encode())),
        (_ASIDE, lambda self, value: self.note("aside")),
        (re.Pattern, lambda self, value: self.note("pattern", repr(value).encode())),
        (mujoco.MjModel, _model),
        (type, _class),
        (_TYPING, lambda self, value: self.note("type", repr(value).encode())),
        (types.FunctionType, _function),
        (
            types.MethodType,
            lambda self, value: self.add_all("method", [value.__func__, value.__self__]),
        ),
        (
            functools.partial,
            lambda self, value: self.add_all("partial", [value.func, value.args, value.keywords]),
        ),
        (_WRAPPERS, lambda self, value: self.add_all("wrapper", [value.__wrapped__])),
        (functools.cached_property, lambda self, value: self.add_all("cached", [value.func])),
        (property, lambda self, value: self.add_all("property", [value.fget])),
        (
            staticmethod | classmethod,
            lambda self, value: self.add_all("static", [type(value), value.__func__]),
        ),
    )


_CONSTANTS = (type(Ellipsis), type(NotImplemented))
# Of a class: what does not tell what its objects do.
_LEFT_OUT = {
    "__module__",
    "__dict__",
    "__weakref__",
    "__doc__",
    "__annotations__",
    "__abstractmethods__",
    "_abc_impl",
    "__dataclass_params__",
    "__dataclass_fields__",
    "__match_args__",
    "__slotnames__",
    "__annotations_cache__",
    "__orig_bases__",
    "__parameters__",
}


def _of_package(module: str | None) -> bool:
    return (module or "").partition(".")[0] == _PACKAGE


def _is_generated(content: Any) -> bool:
    """Whether a class has something only because it is a named tuple; its fields tell it all."""
    if isinstance(content, _FIELD):
        return True
    function = getattr(content, "__func__", content)
    module = getattr(function, "__globals__", {}).get("__name__", "")
    return module.startswith("namedtuple_") or module in ("collections", "dataclasses")


def _is_known(value: Any) -> bool:
    """Whether something belongs to Python or a library, and is found there by its name."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str):
        return False
    if module.partition(".")[0] not in _KNOWN or module not in sys.modules:
        return False
    found: Any = sys.modules[module]
    for part in name.split("."):
        found = getattr(found, part, None)
    return found is value


def _names(code: types.CodeType) -> set[str]:
    """All names in a function and those in it, of globals, attributes and imports."""
    inner = (x for x in code.co_consts if isinstance(x, types.CodeType))
    return set(code.co_names).union(*map(_names, inner))
