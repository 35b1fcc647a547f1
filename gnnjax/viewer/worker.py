"""A thread that does the latest of what it is asked for."""

import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import NamedTuple


class _Task(NamedTuple):
    due: float  # of `time.monotonic`
    work: Callable[[], None]


class Worker:
    """Works in one thread, on the latest task of each kind; what is asked again is replaced.

    What is asked for again and again, while something is dragged, is done once there is a pause.
    """

    def __init__(self, fail: Callable[[Exception], None]):
        """Args:
        fail: told of what a task raises, which goes to the terminal, too.
        """
        self._fail, self._tasks = fail, dict[str, _Task]()
        self._busy = self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def ask(self, kind: str, work: Callable[[], None], pause_s: float = 0.0) -> None:
        """Replaces the task of a kind that nobody has begun, and has it done after a pause."""
        with self._changed:
            self._tasks[kind] = _Task(time.monotonic() + pause_s, work)
            self._changed.notify_all()

    def wait(self, timeout_s: float) -> bool:
        """Waits until nothing is left to be done; whether it came to that."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._tasks or self._busy), timeout_s)

    def close(self) -> None:
        """Ends the thread after what it is doing."""
        with self._changed:
            self._closed = True
            self._tasks.clear()
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while (work := self._next()) is not None:
            try:
                work()
            except Exception as error:  # or the thread would end, and nothing be planned any more
                traceback.print_exc(file=sys.stderr)
                self._fail(error)
            finally:
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()

    def _next(self) -> Callable[[], None] | None:
        with self._changed:
            while not self._closed:
                now = time.monotonic()
                kind = min(self._tasks, key=lambda kind: self._tasks[kind].due, default=None)
                if kind is None:
                    self._changed.wait()
                elif (left := self._tasks[kind].due - now) > 0:
                    self._changed.wait(left)
                else:
                    self._busy = True
                    return self._tasks.pop(kind).work
        return None
