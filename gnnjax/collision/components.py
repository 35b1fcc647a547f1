"""Maps a function of small arrays over a batch, one array of the batch for each component.

`jax.vmap` puts the batch in front: many tiny matrices, one after the other, in which a CPU finds
nothing to fill its vector units with. Here each number that the function computes becomes an array
over the batch, as in `kinematics.py`, so that nothing but elementwise operations are left, which
the compiler turns into one loop. The function is traced for one element and its operations are
carried out again, by the rules below: what only moves numbers around costs nothing, and what
constants decide is decided here.
"""

import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any, SupportsIndex

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

# The arithmetic, by the names of JAX's primitives. Constants are Python's numbers, and stay so.
_ARITHMETIC: dict[str, Callable[..., Any]] = {
    "abs": abs,
    "add": lambda a, b: b if _is(a, 0) else a if _is(b, 0) else a + b,
    "and": lambda a, b: b if a is True else a if b is True else a & b,
    "div": lambda a, b: np.divide(a, b).item() if _constant(a, b) else a / b,
    "eq": operator.eq,
    "ge": operator.ge,
    "gt": operator.gt,
    "is_finite": lambda a: np.isfinite(a).item() if _constant(a) else jnp.isfinite(a),
    "le": operator.le,
    "lt": operator.lt,
    "max": lambda a, b: max(a, b) if _constant(a, b) else jnp.maximum(a, b),
    "min": lambda a, b: min(a, b) if _constant(a, b) else jnp.minimum(a, b),
    "mul": lambda a, b: _times(a, b) if _constant(a) else _times(b, a),
    "ne": operator.ne,
    "neg": operator.neg,
    "not": lambda a: not a if _constant(a) else ~a,
    "or": lambda a, b: b if a is False else a if b is False else a | b,
    "select_n": lambda which, no, yes: _select(which, yes, no),
    "sign": lambda a: np.sign(a).item() if _constant(a) else jnp.sign(a),
    "square": lambda a: a * a,
    "sqrt": lambda a: np.sqrt(a).item() if _constant(a) else jnp.sqrt(a),
    "sub": lambda a, b: a if _is(b, 0) else a - b,
}
_REDUCTIONS = {
    "reduce_and": "and",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_or": "or",
    "reduce_sum": "add",
}
_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call")


def in_components(
    function: Callable[..., jax.Array], shapes: Sequence[tuple[int, ...]]
) -> Callable[..., np.ndarray]:
    """Makes the same function of components.

    Its arguments and its result are NumPy arrays of objects, of the shapes that `function` has them
    in. Each entry is a number, or an array over the batch; batches broadcast. Numbers must be
    finite, since zero times anything is taken for zero.

    Args:
        function: of float32 arrays, returns one array.
        shapes: of its arguments.

    Raises:
        NotImplementedError: the function does something that has no rule here.
    """
    closed = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(s, jnp.float32) for s in shapes))

    def run(*args: np.ndarray) -> np.ndarray:
        return _run(closed, args)[0]

    def every_rule(number: jax.Array) -> list[jax.Array]:
        return [jnp.asarray(x) for x in run(*(_filled(s, number) for s in shapes)).flat]

    jax.eval_shape(every_rule, jax.ShapeDtypeStruct((), jnp.float32))
    return run


def _filled(shape: Sequence[int], entry: Any) -> np.ndarray:
    # Only assignment of a single entry leaves an array that is one alone.
    array = np.empty(int(np.prod(shape)), object)
    for i in range(len(array)):
        array[i] = entry
    return array.reshape(tuple(shape))


def _objects(values: Any) -> np.ndarray:
    """Constants as Python's numbers, which take the type of what they meet."""
    return np.asarray(values).astype(object)


def _constant(*entries: Any) -> bool:
    return all(isinstance(x, bool | int | float) for x in entries)


def _is(entry: Any, number: int) -> bool:
    return _constant(entry) and entry == number


def _times(a: Any, b: Any) -> Any:
    """a * b, of which a is a constant if any of them is."""
    if _is(a, 0):
        return a
    return b if _is(a, 1) else a * b


def _select(which: Any, yes: Any, no: Any) -> Any:
    if _constant(which):
        return yes if which else no
    return yes if yes is no else jnp.where(which, yes, no)


def _run(closed: ClosedJaxpr, args: Sequence[np.ndarray]) -> list[np.ndarray]:
    values = dict(zip(closed.jaxpr.constvars, map(_objects, closed.consts), strict=True))
    values.update(zip(closed.jaxpr.invars, args, strict=True))

    def read(atom: Any) -> np.ndarray:
        return _objects(atom.val) if isinstance(atom, Literal) else values[atom]

    for equation in _needed(closed):
        name, params = equation.primitive.name, equation.params
        inputs = [read(atom) for atom in equation.invars]
        if name in _CALLS:
            outputs = _run(params["jaxpr" if "jaxpr" in params else "call_jaxpr"], inputs)
        elif name in ("and", "or", "not") and equation.outvars[0].aval.dtype != bool:
            raise NotImplementedError(f"no rule for {name!r} of the bits of integers")
        elif name in _ARITHMETIC:
            outputs = [_each(_ARITHMETIC[name], *inputs)]
        elif name in _REDUCTIONS:
            outputs = [_reduce(_ARITHMETIC[_REDUCTIONS[name]], inputs[0], params["axes"])]
        elif name in _RULES:
            outputs = [_RULES[name](*inputs, **params)]
        else:
            raise NotImplementedError(f"no rule for the operation {name!r}")
        values.update(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in closed.jaxpr.outvars]


def _needed(closed: ClosedJaxpr) -> list[Any]:
    """The operations that the results depend on."""
    wanted = {x for x in closed.jaxpr.outvars if not isinstance(x, Literal)}
    kept = []
    for equation in reversed(closed.jaxpr.eqns):
        if not wanted.isdisjoint(equation.outvars):
            wanted.update(x for x in equation.invars if not isinstance(x, Literal))
            kept.append(equation)
    return kept[::-1]


def _each(rule: Callable[..., Any], *inputs: np.ndarray) -> np.ndarray:
    """Entry by entry; scalars broadcast."""
    inputs = np.broadcast_arrays(*inputs)
    result = np.empty(inputs[0].size, object)
    for i, entries in enumerate(zip(*(x.flat for x in inputs), strict=True)):
        result[i] = rule(*entries)
    return result.reshape(inputs[0].shape)


def _along(x: np.ndarray, axis: int) -> list[np.ndarray]:
    # Not by iteration, which takes entries of arrays with one axis out of them.
    return [np.take(x, [i], axis).squeeze(axis) for i in range(x.shape[axis])]


def _reduce(rule: Callable[..., Any], x: np.ndarray, axes: Sequence[SupportsIndex]) -> np.ndarray:
    for axis in sorted(map(int, axes), reverse=True):
        x = functools.reduce(functools.partial(_each, rule), _along(x, axis))
    return x


def _dot_general(a: np.ndarray, b: np.ndarray, *, dimension_numbers, **_) -> np.ndarray:
    (a_sum, b_sum), (a_batch, b_batch) = dimension_numbers
    a_free = [i for i in range(a.ndim) if i not in (*a_sum, *a_batch)]
    b_free = [i for i in range(b.ndim) if i not in (*b_sum, *b_batch)]
    batch, rows, columns = (
        [x.shape[i] for i in axes] for x, axes in ((a, a_batch), (a, a_free), (b, b_free))
    )
    a = a.transpose(*a_batch, *a_free, *a_sum).reshape(*batch, *rows, *[1] * len(columns), -1)
    b = b.transpose(*b_batch, *b_free, *b_sum).reshape(*batch, *[1] * len(rows), *columns, -1)
    return _reduce(_ARITHMETIC["add"], _each(_ARITHMETIC["mul"], a, b), [a.ndim - 1])


def _arg_best(better: str, x: np.ndarray, *, axes: Sequence[SupportsIndex], **_) -> np.ndarray:
    (axis,) = axes
    best, *others = _along(x, int(axis))
    found = _filled(best.shape, 0)
    for number, other in enumerate(others, start=1):
        wins = _each(_ARITHMETIC[better], other, best)  # of equals the first
        best = _each(_select, wins, other, best)
        found = _each(lambda w, f, n=number: _select(w, n, f), wins, found)
    return found


def _cut(x: np.ndarray, start: Sequence[Any], sizes: Sequence[SupportsIndex]) -> np.ndarray:
    """A part of x; moved inside where it would leave x, as JAX's indices do unless told."""
    for d, index in enumerate(start):
        last = x.shape[d] - int(sizes[d])
        if not _constant(index):
            # Not known before it runs: all that it can be, and the choice among them.
            parts = [_cut(x, [*start[:d], i, *start[d + 1 :]], sizes) for i in range(last + 1)]
            chosen = parts[0]
            for i, part in enumerate(parts[1:], start=1):
                chosen = _each(functools.partial(_select, index >= i), part, chosen)
            return chosen
        start = [*start[:d], min(max(int(index), 0), last), *start[d + 1 :]]
    return x[tuple(slice(i, i + int(n)) for i, n in zip(start, sizes, strict=True))]


def _gather(x, indices, *, dimension_numbers, slice_sizes, **_) -> np.ndarray:
    numbers = dimension_numbers
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    kept = [int(size) for d, size in enumerate(slice_sizes) if d not in dropped]
    batch = indices.shape[:-1]
    result = np.empty((*batch, *kept), object)
    for place in np.ndindex(*batch):
        start: list[Any] = [0] * x.ndim
        for d, index in zip(numbers.start_index_map, indices[place], strict=True):
            start[d] = index
        for d, axis in zip(
            numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True
        ):
            start[d] = place[axis]
        result[(*place, ...)] = _cut(x, start, slice_sizes).reshape(kept)
    return np.moveaxis(result, range(len(batch), result.ndim), numbers.offset_dims)


def _dynamic_slice(x: np.ndarray, *start: np.ndarray, slice_sizes, **_) -> np.ndarray:
    return _cut(x, [index.item() for index in start], slice_sizes)


def _broadcast(x: np.ndarray, *, shape, broadcast_dimensions, **_) -> np.ndarray:
    ones = [1] * len(shape)
    for size, axis in zip(x.shape, broadcast_dimensions, strict=True):
        ones[axis] = size
    return np.broadcast_to(x.reshape(ones), shape)


def _slice(x: np.ndarray, *, start_indices, limit_indices, strides, **_) -> np.ndarray:
    steps = [1] * x.ndim if strides is None else strides
    return x[tuple(itertools.starmap(slice, zip(start_indices, limit_indices, steps, strict=True)))]


def _convert(x: np.ndarray, *, new_dtype, **_) -> np.ndarray:
    kind = {"b": bool, "i": int, "u": int, "f": float}[np.dtype(new_dtype).kind]
    return _each(lambda a: kind(a) if _constant(a) else a.astype(new_dtype), x)


def _iota(*, shape, dimension, **_) -> np.ndarray:
    return _objects(np.indices(shape)[dimension])


# Operations that know about shapes.
_RULES: dict[str, Callable[..., np.ndarray]] = {
    "argmax": functools.partial(_arg_best, "gt"),
    "argmin": functools.partial(_arg_best, "lt"),
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *x, dimension, **_: np.concatenate(x, axis=dimension),
    "convert_element_type": _convert,
    "copy": lambda x, **_: x,
    "dot_general": _dot_general,
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    "iota": _iota,
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "slice": _slice,
    "squeeze": lambda x, *, dimensions, **_: x.squeeze(tuple(dimensions)),
    "stack": lambda *x, axis, **_: np.stack(x, axis=axis),
    "tile": lambda x, *, reps, **_: np.tile(x, reps),
    "transpose": lambda x, *, permutation, **_: x.transpose(permutation),
}
