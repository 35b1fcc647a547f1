"""Errors that a person can act on, in one line."""

import contextlib
import dataclasses
import difflib
import errno
import numbers
import os
import re
import reprlib
import select
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import Any, NoReturn, TextIO, TypeGuard

import jax
import numpy as np
from numpy.typing import ArrayLike

from gnnjax import interruption, notice

_FULL = "make room and start the same command again"
_REMEDIES = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,
    errno.EACCES: "check its permissions",
    errno.EROFS: "choose another place",
}


class InputError(ValueError):
    """Bad input: one sentence that names the value and the remedy.

    Commands print it as a single line and exit with status 2; library users catch it as a
    `ValueError`. A message that values from a file make too long loses its middle.
    """

    def __init__(self, message: str):
        super().__init__(one_line(message))


def is_list(values: object) -> TypeGuard[Collection[Any]]:
    """Whether there are items to go through, as often as one likes; a text is no list, and what
    can be gone through once, as a generator, has nothing left after the first look."""
    return isinstance(values, Collection) and not isinstance(values, str)


def is_pair_of_names(value: object) -> TypeGuard[tuple[str, str]]:
    """Whether it is two texts."""
    return (
        isinstance(value, tuple | list)
        and len(value) == 2
        and all(isinstance(name, str) for name in value)
    )


def one_line(text: str, most: int = 299) -> str:
    """Text as one line. Of what is too long the middle goes; what and remedy are at the ends."""
    if len(text) > 10_000:
        text = text[:5000] + text[-5000:]
    text = " ".join(text.split())
    text = "".join(x if x.isprintable() else "?" for x in text)
    half = (most - 5) // 2
    return text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"


_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 60


def brief(value: object) -> str:
    """The `repr` of a value from a file, however large it is or deep."""
    return _REPR.repr(value)


def perhaps(name: str, known: Sequence[str]) -> str:
    """Of a name that there is not, which of those that there are may be meant, for a message."""
    near = difflib.get_close_matches(name, known, n=1)
    return f" (perhaps {near[0]!r})" if near else ""


def as_typed(values: ArrayLike | float) -> Any:
    """Numbers as they were typed, as a number or lists: 0.12 is 0.11999999731779099 once it was in
    single precision."""
    exact = np.asarray(values, float)
    with np.errstate(over="ignore"):
        single = exact.astype(np.float32)
    shortest = single.astype(str).astype(float)
    return np.where(single == exact, shortest, exact).tolist()


def check_option_names(kind: type, options: dict[str, Any], of: str) -> None:
    """Raises for the name of an option that is no field of a dataclass."""
    known = [field.name for field in dataclasses.fields(kind)]
    unknown = sorted(options.keys() - set(known))
    if unknown:
        raise InputError(f"no option {unknown[0]!r} of {of}; there are {known}")


@contextlib.contextmanager
def needs_extra(what: str, extra: str) -> Iterator[None]:
    """Imports within it that fail say which of the package's extras `what` needs."""
    try:
        yield
    except ImportError as error:
        raise InputError(
            f"{what} needs the {extra} extra ({error}); pip install 'gnnjax[{extra}]'"
        ) from None


def is_out_of_memory(error: Exception) -> bool:
    """Whether memory ran out, Python's or a device's."""
    if isinstance(error, jax.errors.JaxRuntimeError):
        return "RESOURCE_EXHAUSTED" in str(error)
    return isinstance(error, MemoryError)


_OPTIONS: set[str] = set()  # of the command that runs, as its configuration calls them
# What messages say to give to a function of the package; calls are named as they are.
_ARGUMENT = re.compile(r"(?<![\w(])([a-z_]+)=(\[.*?\]|\{.*?\}|[\w.+-]+)")


def name_options(names: Iterable[str]) -> None:
    """Says which arguments that messages name are options of the command that runs."""
    _OPTIONS.clear()
    _OPTIONS.update(names)


def _for_the_shell(said: str) -> str:
    """A message whose remedies are the options of the command, which has them as arguments of
    functions: `hold={'a': 1}` is `--hold a 1` there."""

    def option(found: re.Match) -> str:
        name, value = found.groups()
        if name not in _OPTIONS:
            return found[0]
        flag = name.replace("_", "-")
        if value in ("True", "False"):
            return f"--{flag}" if value == "True" else f"--no-{flag}"
        return " ".join([f"--{flag}", *re.sub(r"[][(){}'\",:]", " ", value).split()])

    return _ARGUMENT.sub(option, said)


def run_command(
    main: Callable[[], int | None],
    again: str = "start the same command again",
    smaller: str = "ask for less at once",
) -> NoReturn:
    """Runs a command's `main` and exits with its status, without a traceback for bad input. Where
    nobody reads on what it prints (`| head`), it ends without a word, with status 141.

    Args:
        main: the command.
        again: what a user does to go on after an interruption.
        smaller: what a user does where memory does not suffice.
    """
    notice.silence()
    for name in ("stdout", "stderr"):  # which may have been closed before
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))
    status = 128 + 13  # of what SIGPIPE has ended, in shells
    with contextlib.suppress(BrokenPipeError):
        status = _status(main, again, smaller)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # Python would try again, and say so
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(status)


def _status(main: Callable[[], int | None], again: str, smaller: str) -> Any:
    """Runs `main` and says what went wrong."""
    try:
        with interruption.running(again):
            try:
                status = main() or 0
            except SystemExit as error:  # --help
                status = error.code
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
        return status
    except InputError as error:
        said = _for_the_shell(str(error))
    except OSError as error:  # disk full, permission denied, a folder that is missing
        if isinstance(error, BrokenPipeError) and (
            _is_unread(sys.stdout) or _is_unread(sys.stderr)
        ):
            raise
        named = f"{error.strerror}: {error.filename}" if error.filename else str(error)
        remedy = _REMEDIES.get(error.errno or 0, "check the path")
        said = one_line(f"{named}; {remedy}")
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        said = one_line(f"not enough memory; {smaller} ({error})")
    print(f"error: {said}", file=sys.stderr)
    return 2


def _is_unread(stream: TextIO) -> bool:
    """Whether a stream is a pipe whose reader is gone."""
    if not hasattr(select, "poll"):  # no POSIX
        return True
    poll = select.poll()
    poll.register(stream.fileno(), 0)
    return bool(poll.poll(0))


def as_floats(values: Any) -> np.ndarray:
    """Numbers in double precision. Texts and truth values are none, which NumPy takes for such.

    Raises:
        TypeError, ValueError or OverflowError: there are others.
    """
    array = np.asarray(values)
    if array.dtype.kind in "bSUmM":
        raise TypeError(f"{array.dtype} are no numbers")
    return array.astype(float, copy=False)


def check_number(value: Any, called: str) -> None:
    """Raises for what is no real number, such as its text, which nothing can be compared with."""
    if not isinstance(value, numbers.Real):
        # Arrays of no axes are numbers, too, NumPy's and JAX's.
        kind = np.asarray(value).dtype.kind if getattr(value, "ndim", None) == 0 else "O"
        if kind not in "biuf":
            raise InputError(f"{called} is {brief(value)}; give a number")


def check_seed(seed: int) -> int:
    """Returns a seed that JAX can take, or says that it cannot."""
    if not isinstance(seed, int | np.integer) or not 0 <= seed < 2**31:
        raise InputError(f"seed is {seed}; choose an integer from 0 to {2**31 - 1}")
    return seed
