"""Ctrl-C (SIGINT) and SIGTERM end a command with one sentence, whatever it is doing.

`python -m gnnjax.plan` imports the package for seconds before the first line of `plan.py` runs. So
the package imports this module first, and this module sees by how Python was started that a command
of ours is to run. For anyone else the import changes nothing.
"""

import contextlib
import itertools
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from typing import NoReturn

# What a command has to take its files away. Where it has not come to that by then, it is in a
# function of C, such as XLA's compiler, which would hold the signal back for up to a minute.
_GRACE_S = 3.0

_WORDS = {int(signal.SIGINT): "interrupted", int(signal.SIGTERM): "terminated"}


class _State:
    """What the handlers know; there is one command a process."""

    installed = False
    running = False  # the command is past its imports, and can clean up
    asked: int | None = None  # the signal that came
    again = "start the same command again"


class Interrupted(KeyboardInterrupt):
    """A signal asks the command to end."""


def is_command(arguments: list[str], first: str) -> bool:
    """Whether Python was started for a module of ours, and is looking for it just now.

    Args:
        arguments: `sys.orig_argv`.
        first: `sys.argv[0]`, which is "-m" until the module is found.
    """
    named = [after for word, after in itertools.pairwise(arguments) if word == "-m"]
    named += [word.removeprefix("-m") for word in arguments if word.startswith("-m")]
    return first == "-m" and named[0].startswith(("gnnjax.", "experiments."))


def install() -> None:
    """Sets the handlers. A signal that whoever started us ignores, as `nohup` does, stays so."""
    _State.installed = True
    for number in _WORDS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)
    if os.name == "posix":
        read, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        threading.Thread(target=_watch, args=(read,), daemon=True).start()


@contextlib.contextmanager
def running(again: str) -> Iterator[None]:
    """In here a signal is raised as an exception, so that files are taken away.

    Args:
        again: what the user is told to do to go on.
    """
    _State.again, _State.running = again, True
    try:
        yield
        if _State.installed:  # all is done and written: nothing is left to interrupt
            for number in _WORDS:
                signal.signal(number, signal.SIG_IGN)
    except BaseException as error:
        # Libraries may turn what the handler raised into an exception of theirs.
        if _State.asked is not None or isinstance(error, KeyboardInterrupt):
            with contextlib.suppress(Exception):
                sys.stdout.flush()
            end(_State.asked or signal.SIGINT)
        raise
    finally:
        _State.running = False


def end(number: int) -> NoReturn:
    """Ends the process with the sentence and the status of a signal."""
    sentence = f"{_WORDS[number]}; {_State.again} to go on\n"
    if not _State.installed:
        sys.stderr.write(sentence)
        sys.exit(128 + number)
    if os.isatty(2):  # after "^C" and a progress bar, which hides the cursor
        sentence = "\n\x1b[?25h" + sentence
    with contextlib.suppress(OSError):
        os.write(2, sentence.encode())
    # No shutdown of the interpreter: XLA's threads, still compiling, would crash in it.
    os._exit(128 + number)


def _handle(number: int, frame: object) -> None:
    if not _State.running or _State.asked is not None:
        end(number)
    _State.asked = number
    # What is torn down now is nobody's fault.
    sys.unraisablehook = threading.excepthook = lambda error: None
    raise Interrupted


def _watch(pipe: int) -> None:
    """Ends the process when the main thread does not, or when asked twice."""
    number = 0
    while number not in _WORDS:
        number = os.read(pipe, 1)[0]
    select.select([pipe], [], [], _GRACE_S)
    end(number)


if is_command(sys.orig_argv, sys.argv[0] if sys.argv else ""):
    install()
