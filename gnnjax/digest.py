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
from pathlib import PurePath
from typing import Any

import jax
import mujoco
import numpy as np

_PACKAGE = __name__.partition(".")[0]
# What stands for itself by its name.
_KNOWN = {"jax", "jaxlib", "numpy", "scipy", "mujoco", "jaxtyping", "ml_dtypes"}
_KNOWN |= sys.stdlib_module_names
_WRAPPERS = (type(jax.jit(lambda: None)), type(functools.cache(lambda: None)))
# What tells nothing of a result: messages, and whose turn it is.
_ASIDE = (logging.Logger, reprlib.Repr, type(threading.Lock()), type(threading.RLock()))
# MuJoCo's enumerations have no common class.
_ENUMS = (enum.Enum, *(x for x in vars(mujoco).values() if hasattr(x, "__members__")))
_ANNOTATIONS = (
    *(types.GenericAlias, types.UnionType, typing.TypeVar),
    *map(type, (typing.Any, typing.Callable, typing.Callable[[], None], typing.Literal[0])),
)
_CONTAINERS = (dict, list, set, frozenset, str, bytes, int, float, complex)
_FIELD = type(typing.NamedTuple("_One", [("one", int)]).one)  # what a field of one is
# Of a class: what does not tell what its objects do.
_LEFT_OUT = set(
    "__module__ __dict__ __weakref__ __doc__ __annotations__ __annotations_cache__ __slotnames__ "
    "__abstractmethods__ _abc_impl __dataclass_params__ __dataclass_fields__ __match_args__ "
    "__orig_bases__ __parameters__".split()
)


class Undigested(Exception):
    """Something that has no digest."""


def digest(*values: Any) -> str:
    """The digest of some values.

    Raises:
        Undigested: they hold something that has none; it says what.
    """
    walk = _Walk()
    try:
        walk.add_all("values", values)
    except Undigested:
        raise
    except Exception as error:  # nearly anything, of objects that nobody here has made
        raise Undigested(f"what cannot be looked at: {error!r}") from error
    return walk.found.hexdigest()


class _Walk:
    """One walk through all that can be reached; what was met before is only referred to."""

    def __init__(self):
        self.found = hashlib.sha256()
        self.seen: dict[int, int] = {}
        self.inside: set[int] = set()  # modules whose globals are being looked up
        self.alive: list[Any] = []  # as long as they are, nothing else has their id

    def note(self, kind: str, content: Any = "") -> None:
        """Takes down one fact; no two sequences of facts read the same."""
        if not isinstance(content, bytes):
            content = repr(content).encode()
        self.found.update(f"{kind}:{len(content)}:".encode() + content)

    def add_all(self, kind: str, values: Iterable[Any]) -> None:
        """Goes on to some values."""
        values = list(values)
        self.note(kind, len(values))
        for value in values:
            self.add(value)

    def add(self, value: Any) -> None:
        """Goes on to a value."""
        kind = type(value)
        if value is None or value is Ellipsis or kind in (bool, int, complex, str, bytes):
            self.note(kind.__name__, value)
        elif kind is float:
            self.note("float", struct.pack("<d", value))
        elif id(value) in self.seen:
            self.note("again", self.seen[id(value)])
        else:
            self.seen[id(value)] = len(self.seen)
            self.alive.append(value)
            self._add_new(value)

    def _add_new(self, value: Any) -> None:
        kind = type(value)
        if isinstance(value, jax.core.Tracer):
            raise Undigested("a tracer")
        if _is_known(value):
            return self.note("known", f"{value.__module__}.{value.__qualname__}")
        for kinds, add in _RULES:
            if isinstance(value, kinds):
                return add(self, value)
        if kind in (list, tuple):
            return self.add_all(kind.__name__, value)
        if kind in (dict, types.MappingProxyType):
            return self.add_all(kind.__name__, (x for two in value.items() for x in two))
        if kind in (set, frozenset):
            return self.note(kind.__name__, sorted(map(digest, value)))
        # A tuple is a named one; what others hold beside their attributes, nobody knows.
        if not _of_package(kind.__module__) or isinstance(value, _CONTAINERS):
            raise Undigested(f"an object of {kind.__module__}.{kind.__qualname__}")
        return self.object(value)

    def array(self, value: Any) -> None:
        kind, dtype = type(value).__name__, value.dtype
        if isinstance(value, jax.Array):
            kind = f"jax {value.weak_type}"
        if not isinstance(dtype, np.dtype) or dtype.hasobject or dtype.fields:
            raise Undigested(f"an array of {dtype}")
        self.note("array", (kind, dtype.name, dtype.str, value.shape))
        self.note("bytes", np.asarray(value).tobytes())

    def function(self, value: types.FunctionType) -> None:
        module = value.__globals__.get("__name__", "")
        root = module.partition(".")[0]
        checks_types = root == "jaxtyping" or hasattr(value, "__beartype_wrapper")
        if checks_types and hasattr(value, "__wrapped__"):  # which is called
            return self.add(value.__wrapped__)
        if not _of_package(module) and root not in _KNOWN:
            raise Undigested(f"the function {module}.{value.__qualname__}")
        self.note("function", f"{module}.{value.__qualname__}")
        self.code(value.__code__)
        self.add_all("parts", [value.__defaults__, value.__kwdefaults__, vars(value)])
        for cell in value.__closure__ or ():
            try:
                content = cell.cell_contents
            except ValueError:
                self.note("empty")
            else:
                self.add(content)
        if _of_package(module):
            self.globals(value.__globals__, _names(value.__code__))

    def code(self, code: types.CodeType) -> None:
        self.note("bytecode", code.co_code)
        self.note("exceptions", code.co_exceptiontable)
        counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        self.note("names", (counts, names, len(code.co_consts)))
        for value in code.co_consts:
            if isinstance(value, types.CodeType):
                self.code(value)
            else:
                self.add(value)

    def globals(self, space: dict[str, Any], names: set[str]) -> None:
        """The globals of these names; of modules of the package, what has one of them, too."""
        for name in sorted(names):
            if name in space:
                value = space[name]
            elif _of_package(name):  # imported inside of a function
                value = importlib.import_module(name)
            elif name in sys.modules and name.partition(".")[0] not in _KNOWN:
                raise Undigested(f"the module {name}")  # or else an attribute that is called so
            else:
                continue
            self.note("global", name)
            if not isinstance(value, types.ModuleType):
                self.add(value)
            elif not _of_package(value.__name__):
                self.module(value)
            elif id(value) not in self.inside:  # its own names may lead back to it
                self.inside.add(id(value))
                self.globals(vars(value), names)
                self.inside.remove(id(value))
        self.note("end")

    def module(self, value: types.ModuleType) -> None:
        if value.__name__.partition(".")[0] not in _KNOWN:
            raise Undigested(f"the module {value.__name__}")
        self.note("module", value.__name__)

    def class_(self, value: type) -> None:
        name = f"{value.__module__}.{value.__qualname__}"
        if value.__module__.partition(".")[0] in _KNOWN and "<locals>" not in name:
            return self.note("known class", (name, repr(value)))
        if not _of_package(value.__module__):
            raise Undigested(f"the class {name}")
        self.note("class", name)
        self.add_all("bases", value.__bases__)
        for name, content in vars(value).items():
            if name not in _LEFT_OUT and not _is_generated(content):
                self.note("attribute", name)
                self.add(content)
        self.note("end")

    def object(self, value: Any) -> None:
        """An object of the package: its class, and what it holds but for what it has derived."""
        kind = type(value)
        self.note("object")
        self.add(kind)
        if isinstance(value, tuple):
            self.add_all("fields", value)
        state = value.__getstate__() or {}
        if not isinstance(state, dict):
            raise Undigested(f"an object of {kind.__module__}.{kind.__qualname__}, with slots")
        for name in sorted(state):
            if not isinstance(getattr(kind, name, None), functools.cached_property):
                self.note("attribute", name)
                self.add(state[name])
        self.note("end")

    def model(self, value: mujoco.MjModel) -> None:
        content = np.zeros(mujoco.mj_sizeModel(value), np.uint8)
        mujoco.mj_saveModel(value, None, content)
        self.note("model", content.tobytes())


# How kinds of values are looked at, the first that fits.
_RULES: tuple[tuple[Any, Callable[[_Walk, Any], None]], ...] = (
    ((np.ndarray, np.generic, jax.Array), _Walk.array),
    (np.dtype, lambda walk, value: walk.note("dtype", (value.str, value.name))),
    (np.ufunc, lambda walk, value: walk.note("ufunc", value.__name__)),
    (_ENUMS, lambda walk, value: walk.add_all("member", [type(value), value.name])),
    (PurePath, lambda walk, value: walk.note("path", str(value))),
    (re.Pattern, lambda walk, value: walk.note("pattern", (value.pattern, value.flags))),
    (_ASIDE, lambda walk, value: walk.note("aside")),
    (mujoco.MjModel, _Walk.model),
    (types.ModuleType, _Walk.module),
    (type, _Walk.class_),
    (_ANNOTATIONS, lambda walk, value: walk.note("annotation", value)),
    (types.FunctionType, _Walk.function),
    (
        types.MethodType,
        lambda walk, value: walk.add_all("method", [value.__func__, value.__self__]),
    ),
    (
        functools.partial,
        lambda walk, value: walk.add_all("partial", [value.func, value.args, value.keywords]),
    ),
    (_WRAPPERS, lambda walk, value: walk.add_all("wrapper", [value.__wrapped__])),
    (functools.cached_property, lambda walk, value: walk.add_all("cached", [value.func])),
    (property, lambda walk, value: walk.add_all("property", [value.fget])),
    (
        (staticmethod, classmethod),
        lambda walk, value: walk.add_all(type(value).__name__, [value.__func__]),
    ),
    (slice, lambda walk, value: walk.add_all("slice", [value.start, value.stop, value.step])),
    (range, lambda walk, value: walk.note("range", value)),
)


def _of_package(module: str | None) -> bool:
    return (module or "").partition(".")[0] == _PACKAGE


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


def _is_generated(content: Any) -> bool:
    """Whether a class has something only because it is a named tuple or a dataclass; its fields
    and their defaults tell it all."""
    if isinstance(content, _FIELD):
        return True
    module = getattr(getattr(content, "__func__", content), "__globals__", {}).get("__name__", "")
    return module.startswith("namedtuple_") or module in ("collections", "dataclasses")


def _names(code: types.CodeType) -> set[str]:
    """All names in a function and those in it, of globals, attributes and imports."""
    inner = (x for x in code.co_consts if isinstance(x, types.CodeType))
    return set(code.co_names).union(*map(_names, inner))
