"""Types are checked as jaxtyping's import hook does it, but faster; imported before the package is.

What jaxtyping does more than the type checker itself is to compare shapes. For functions whose
types have none, that took up to a tenth of the time of tests.
"""

import functools
import types
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping import TypeCheckError, _decorator

_jaxtyped = jaxtyping.jaxtyped
# With jaxtyping's error, which is a `TypeError`.
_checked = beartype(conf=BeartypeConf(violation_type=TypeCheckError))


def _may_have_shapes(hint: Any) -> bool:
    """Whether a type is one of arrays of a shape, or made of such; of text, nobody knows."""
    if isinstance(hint, list):  # arguments of a `Callable`
        return any(map(_may_have_shapes, hint))
    if isinstance(hint, str | typing.ForwardRef) or type(hint).__module__.startswith("jaxtyping"):
        return True
    return any(map(_may_have_shapes, typing.get_args(hint)))


def _jaxtyped_where_shapes_are(fn: Any, *, typechecker: Callable) -> Any:
    is_outermost = isinstance(fn, types.FunctionType) and "<locals>" not in fn.__qualname__
    if is_outermost and not any(map(_may_have_shapes, fn.__annotations__.values())):
        return _checked(fn)
    return _jaxtyped(fn, typechecker=typechecker)


def _once(make: Callable) -> Callable:
    """What `make` made of the same arguments before; of lists and arrays it makes it anew."""
    remembered = functools.cache(make)

    def make_once(*args, **kwargs):
        try:
            hash((args, *kwargs.values()))
        except TypeError:
            return make(*args, **kwargs)
        return remembered(*args, **kwargs)

    return make_once


jaxtyping.jaxtyped = lambda *, typechecker: functools.partial(
    _jaxtyped_where_shapes_are, typechecker=typechecker
)
# Types are checked in functions within functions, too. What checks those of a signature is made
# once, not each time that the outer function is called, which took longer than many a test.
for _name in ("_make_fn_with_signature", "_apply_typechecker"):
    setattr(_decorator, _name, _once(getattr(_decorator, _name)))
