"""Processes of one command that share its work, on one machine or many: who is done, who is lost.

They meet in files beside what they make, in a folder that all of them see. Each writes one every
second; whose stays as it is was killed, or its machine is gone. Nothing has to be connected, and
nothing that somebody else has made is lost with a process.
"""

import contextlib
import glob
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import jax

from gnnjax.errors import InputError, is_out_of_memory, one_line
from gnnjax.files import locked

_BEAT_S = 1.0
_MARGIN_S = 5.0  # beyond its patience, until a loss has come to the first process and back
_FAREWELL_S = 30.0  # what the first process waits for the others to have read how it ended


class Place(NamedTuple):
    """Which of how many processes this one is."""

    index: int = 0
    count: int = 1

    def has(self, number: int) -> bool:
        """Whether a part of the work is this process's; whoever made it before plays no role."""
        return number % self.count == self.index


class LostProcess(InputError):
    """Another process of the command has ended before its time."""


class RollCall:
    """Says that this process is there, and finds out whether the others are: a context manager.

    A process that fails leaves its reason for the others. The first one looks at all of them, the
    others at the first alone, which passes on what it sees.

    Args:
        target: what the processes make together; their files lie beside it.
        place: of this process. A single one has nobody to wait for, and writes nothing.
        patience: seconds without a sign after which a process counts as lost.
        all_at_once: no process can go on without the others. This one then ends as soon as another
            is lost, whatever it is doing, with a sentence and status 2.
    """

    def __init__(
        self, target: Path, place: Place, patience: float = 120.0, all_at_once: bool = False
    ):
        self._target, self._place, self._all_at_once = target, place, all_at_once
        self._patience = patience
        self._others = range(1, place.count) if place.index == 0 else range(1)
        self._state, self._words, self._beats = "working", "", 0
        self._lock, self._ended = threading.Lock(), threading.Event()
        # What others have written, when it was looked at last; how long it has been like that; and
        # whether it ever changed: else it may be of an earlier run.
        self._seen: dict[int, str] = {}
        self._quiet: dict[int, float] = {}
        self._there: set[int] = set()
        self._lost: set[int] = set()

    def __enter__(self) -> "RollCall":
        if self._place.count > 1:
            self._held = locked(self._file(self._place.index))
            self._held.__enter__()
            self._seen = {index: self._read(index) for index in self._others}
            self._quiet = dict.fromkeys(self._others, 0.0)
            self._say("working")
            self._thread = threading.Thread(target=self._beat, daemon=True)
            self._thread.start()
        return self

    def gather(self) -> bool:
        """Waits until all processes have come to this point.

        Returns:
            True to the first one, which does what is left for one alone; False to the others, when
            that is done.

        Raises:
            LostProcess: one has ended before.
        """
        if self._place.count == 1:
            return True
        self._say("done")
        first = self._place.index == 0
        self._quiet = dict.fromkeys(self._others, 0.0)  # from now on, others are waited for
        awaited, last = set(self._others), time.monotonic()
        while awaited:
            now = time.monotonic()
            awaited -= self._look(awaited, "done" if first else "over", now - last)
            last = now
            time.sleep(_BEAT_S / 2)
        return first

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if self._place.count == 1:
            if error is None:
                self._remove_what_is_left()
            return
        if self._all_at_once and isinstance(error, jax.errors.JaxRuntimeError):
            # Most likely another is gone, which the thread is about to find out.
            self._thread.join(0.0 if is_out_of_memory(error) else self._patience + _MARGIN_S)
        if error is None:
            self._say("over")
        else:
            self._fail(error)
        self._ended.set()
        self._thread.join()
        own, left = self._file(self._place.index), ()
        if self._place.index == 0:
            # The first one takes away what runs that were killed have left, too.
            if self._all_at_once or error is None:
                alone = self._wait_for_farewell()
                beside = f"{glob.escape(self._name(''))}*"
                if alone and error is None:
                    left = (*own.parent.glob(beside), *own.parent.glob(f".{beside}.lock"))
        elif error is None:
            left = (own,)
        for file in left:
            file.unlink(missing_ok=True)
        self._held.__exit__(None, None, None)

    def _remove_what_is_left(self) -> None:
        """Takes away the files of several that were killed, once a single process has made what was
        missing; whose lock is held is still there, and keeps its own."""
        folder, beside = self._target.parent, f"{glob.escape(self._name(''))}*"
        names = {file.name.removesuffix(".new") for file in folder.glob(beside)}
        locks = {file.name[1:].removesuffix(".lock") for file in folder.glob(f".{beside}.lock")}
        for name in names | locks:
            with contextlib.suppress(InputError, OSError), locked(folder / name):
                for file in (folder / name, folder / f"{name}.new"):
                    file.unlink(missing_ok=True)

    def _name(self, number: str) -> str:
        return f".{self._target.name}.process-{number}"

    def _file(self, index: int) -> Path:
        name = self._name(f"{index:05d}-of-{self._place.count:05d}")
        return self._target.with_name(name)

    def _read(self, index: int) -> str:
        try:
            return self._file(index).read_text(encoding="utf-8")
        except OSError:
            return ""

    def _say(self, state: str | None = None, words: str = "") -> None:
        """Writes the state anew; None: the one there was, once more."""
        with self._lock:
            if state is not None:
                self._state, self._words = state, words
            self._beats += 1
            said = [self._state, _this_process(), self._words, self._beats, time.time()]
            file = self._file(self._place.index)
            # No `atomic_write`, which waits for the disk.
            fresh = file.with_name(f"{file.name}.new")
            fresh.write_text(json.dumps(said), encoding="utf-8")
            fresh.replace(file)

    def _beat(self) -> None:
        last = time.monotonic()
        while not self._ended.wait(_BEAT_S):
            with contextlib.suppress(OSError):  # a full disk is said where something is to be made
                self._say()
            if not self._all_at_once or self._state != "working":  # `gather` looks itself
                continue
            now = time.monotonic()
            try:
                self._look(self._others, "over", now - last)
            except LostProcess as error:
                self._fail(error)
                sys.stdout.flush()
                print(f"error: {error}", file=sys.stderr, flush=True)
                if self._place.index == 0:
                    self._wait_for_farewell()
                os._exit(2)
            last = now

    def _look(self, indices: Iterable[int], state: str, elapsed: float) -> set[int]:
        """Who of the others is in that state; raises where one is lost or has failed.

        Args:
            indices: of the others.
            state: which.
            elapsed: seconds since the last look.
        """
        found = set()
        for index in indices:
            text = self._read(index)
            if text and text != self._seen[index]:
                self._seen[index], self._quiet[index] = text, 0.0
                self._there.add(index)
            else:
                # Not the clock's time: whoever was stopped himself, with the others, saw nothing.
                self._quiet[index] += min(elapsed, 2 * _BEAT_S)
            if index in self._there:
                theirs, _, words, *_ = json.loads(self._seen[index])
                if theirs == state:
                    found.add(index)
                elif theirs == "failed":
                    raise LostProcess(words)
            if index not in found and self._quiet[index] > self._patience:
                self._lost.add(index)
                who = f" ({json.loads(self._seen[index])[1]})" if index in self._there else ""
                what = "has not been heard of for" if who else "is not there after"
                raise LostProcess(
                    f"process {index} of {self._place.count}{who} {what} {self._patience:g} s; "
                    "start all of them again to go on"
                )
        return found

    def _fail(self, error: BaseException) -> None:
        """Leaves word of how this process ends."""
        if isinstance(error, LostProcess):
            words = str(error)
        else:
            what = str(error) if isinstance(error, InputError | OSError) else type(error).__name__
            name = f"process {self._place.index} of {self._place.count} ({_this_process()})"
            words = one_line(f"{name} has ended: {what}")
        with contextlib.suppress(OSError):
            self._say("failed", words)

    def _wait_for_farewell(self) -> bool:
        """Lets the others read how this process has ended, before anything of it goes away; returns
        whether all of them have ended."""
        end = time.monotonic() + min(_FAREWELL_S, self._patience)
        awaited = self._there - self._lost
        while awaited and time.monotonic() < end:
            said = {index: self._read(index) for index in awaited}
            awaited = {i for i, text in said.items() if text and json.loads(text)[0] != "failed"}
            time.sleep(_BEAT_S / 2)
        return not awaited


def _this_process() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}"
