"""A line for whoever waits, when something takes long that is done once."""

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

_AFTER_S = 2.0  # of waiting
_APART_S = 30.0  # what begins later is told of anew
_LOCK = threading.Lock()


class _State:
    """What this process has told."""

    silent = False
    waited = 0.0  # s
    told = False
    ended = -float("inf")  # when something of the kind did last, of `time.monotonic`


def silence() -> None:
    """No lines from now on: a command shows what it does itself."""
    _State.silent = True


@contextlib.contextmanager
def told_if_long(line: str) -> Iterator[None]:
    """Prints a line to the errors once what is done in here, and was right before, takes seconds.

    Only where somebody sees it, in a terminal or notebook, and once for all that is done in a row.
    One thread at a time may be in here.
    """
    if _State.silent or not _is_seen():
        yield
        return
    begin = time.monotonic()
    if begin - _State.ended > _APART_S:
        _State.waited, _State.told = 0.0, False
    timer = threading.Timer(max(0.0, _AFTER_S - _State.waited), _tell, [line])
    timer.daemon = True
    if not _State.told:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()
        _State.ended = time.monotonic()
        _State.waited += _State.ended - begin


def _tell(line: str) -> None:
    with _LOCK:
        if _State.told:
            return
        _State.told = True
    with contextlib.suppress(OSError, ValueError):  # a terminal that was closed
        print(line, file=sys.stderr, flush=True)


def _is_seen() -> bool:
    """Whether somebody looks at the errors: a terminal, or what ipykernel sends to a notebook."""
    stream = sys.stderr
    if stream is None or stream.closed:
        return False
    return stream.isatty() or type(stream).__module__.startswith("ipykernel.")
