"""Kills commands before and after each file operation, resumes them, and compares what they write.

    python -m tests.kill_points                            # all points of all commands
    python -m tests.kill_points --commands train --points 30
    python -m tests.kill_points --random 50                # SIGKILL at random times instead
    python -m tests.kill_points --terminate                # SIGTERM at all points instead

A killed process leaves without a word, as after SIGKILL: nothing is flushed, closed or removed. The
file code is the real one, Orbax's included; what is drawn, planned and learned is a few numbers, so
that a run takes milliseconds. Each run is a fork of this process, which must not have begun to use
JAX: its threads would not live on in the fork.
"""

import argparse
import builtins
import contextlib
import functools
import io
import itertools
import json
import os
import pickle
import random
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
from kill_commands import COMMANDS

from gnnjax import interruption

_NAMES = (
    "chmod fsync ftruncate link makedirs mkdir pwrite remove rename replace rmdir symlink truncate "
    "unlink write"
).split()
_KILLED = 9
_LIMIT_S = 120
_TERMINATED = "terminated; start the same command again to go on\n"


class Knife:
    """Counts file operations, and strikes before or after one of them.

    Args:
        point: twice the operation's number; one more for after it.
        terminate: send SIGTERM, which a command answers, instead of ending the process.
    """

    def __init__(self, point: int | None = None, terminate: bool = False):
        self.point, self.terminate = point, terminate
        self.count = 0
        self._lock, self._inside = threading.RLock(), threading.local()

    def around(self, call: Callable, *args: Any, **kwargs: Any) -> Any:
        """Calls, unless the process ends before; operations inside of operations count once."""
        if getattr(self._inside, "busy", False):
            return call(*args, **kwargs)
        with self._lock:
            number, self.count = self.count, self.count + 1
        self._reach(2 * number)
        self._inside.busy = True
        try:
            return call(*args, **kwargs)
        finally:
            self._inside.busy = False
            self._reach(2 * number + 1)

    def _reach(self, point: int) -> None:
        if self.point == point and self.terminate:
            os.kill(os.getpid(), signal.SIGTERM)
        elif self.point == point:
            os._exit(_KILLED)

    @contextlib.contextmanager
    def drawn(self) -> Iterator[None]:
        """In here file operations count."""
        with contextlib.ExitStack() as stack:
            for name in _NAMES:
                wrapped = functools.partial(self.around, getattr(os, name))
                stack.enter_context(mock.patch.object(os, name, wrapped))
            real_open, real_os_open = builtins.open, os.open

            def opened(file: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
                if not set(mode) & set("wax+"):
                    return real_open(file, mode, *args, **kwargs)
                stream = self.around(real_open, file, mode, *args, **kwargs)
                return _CutStream(stream, self)

            def os_opened(path: Any, flags: int, *args: Any, **kwargs: Any) -> int:
                if not flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                    return real_os_open(path, flags, *args, **kwargs)
                return self.around(real_os_open, path, flags, *args, **kwargs)

            stack.enter_context(mock.patch.object(builtins, "open", opened))
            stack.enter_context(mock.patch.object(io, "open", opened))
            stack.enter_context(mock.patch.object(os, "open", os_opened))
            yield


class _CutStream:
    """A file whose writes reach the disk one by one, so that a kill leaves a part of it."""

    def __init__(self, stream: Any, knife: Knife):
        self._stream, self._knife = stream, knife

    def write(self, data: Any) -> int:
        written = self._knife.around(self._stream.write, data)
        self._stream.flush()
        return written

    def __enter__(self) -> "_CutStream":
        return self

    def __exit__(self, *error: object) -> None:
        self._stream.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class Run(NamedTuple):
    """How one process ended."""

    status: int
    words: str  # what it printed as errors
    seconds: float


def run_forked(act: Callable[[], object], kill_after_s: float | None = None) -> Run:
    """Runs `act` in a fork, with its output kept apart."""
    begin = time.perf_counter()
    with tempfile.TemporaryFile() as words:
        child = os.fork()
        if not child:
            status = 1
            try:
                os.dup2(words.fileno(), 2)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                signal.alarm(_LIMIT_S)
                act()
                status = 0
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(status)
        if kill_after_s is not None:
            time.sleep(kill_after_s)
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        words.seek(0)
        text = words.read().decode(errors="replace")
    return Run(status, text, time.perf_counter() - begin)


class Case(NamedTuple):
    """One command, and how a run of it without a kill ends."""

    name: str
    operations: int
    seconds: float
    expected: Any


def undisturbed(name: str, folder: Path) -> Case:
    """Runs a command without kills."""
    knife, command = Knife(), COMMANDS[name]
    (folder / "work").mkdir(parents=True)

    def act() -> None:
        os.chdir(folder / "work")  # relative paths: settings are equal wherever the run is
        command.prepare()
        with knife.drawn():
            command.run(Path("run"))
        (folder / "count").write_text(str(knife.count))
        (folder / "seen").write_bytes(pickle.dumps(command.look(Path("run"))))

    run = run_forked(act)
    if run.status or run.words:
        raise RuntimeError(f"{name} fails without kills:\n{run.words}")
    seen = pickle.loads((folder / "seen").read_bytes())
    return Case(name, int((folder / "count").read_text()), run.seconds, seen)


def try_point(
    case: Case, point: int, folder: Path, at_s: float | None = None, terminate: bool = False
) -> tuple[bool, str]:
    """Kills a run, then resumes it; whether it was killed, and what is wrong afterwards."""
    command = COMMANDS[case.name]
    (folder / "work").mkdir(parents=True)

    def killed() -> None:
        os.chdir(folder / "work")
        command.prepare()
        if terminate:
            interruption.install()
        with Knife(None if at_s is not None else point, terminate).drawn():
            command.run(Path("run"))

    def resumed() -> None:
        os.chdir(folder / "work")
        command.prepare()
        command.run(Path("run"))
        (folder / "seen").write_bytes(pickle.dumps(command.look(Path("run"))))

    first = run_forked(killed, at_s)
    ended = 128 + signal.SIGTERM
    if terminate and (first.status, first.words) not in ((0, ""), (ended, _TERMINATED)):
        return True, f"the run to be terminated ended with {first.status}: {first.words[-500:]}"
    if first.status not in (0, _KILLED, -_KILLED, ended):
        return True, f"the run to be killed ended with {first.status}: {first.words[-500:]}"
    second = run_forked(resumed)
    if second.status or second.words:
        return True, f"the resumed run ended with {second.status}: {second.words[-500:]}"
    found = pickle.loads((folder / "seen").read_bytes())
    different = [
        f"{key}: {str(found.get(key))[:150]} instead of {str(case.expected.get(key))[:150]}"
        for key in sorted(found.keys() | case.expected.keys())
        if found.get(key) != case.expected.get(key)
    ]
    return first.status != 0, "; ".join(different)


def try_command(
    name: str, most: int | None = None, times: int = 0, terminate: bool = False, workers: int = 2
) -> dict[str, Any]:
    """Kills a command and counts what became of it.

    Args:
        name: of the command.
        most: points to try, spread evenly; by default all.
        times: random times to try instead.
        terminate: by SIGTERM, not SIGKILL.
        workers: processes that try points side by side.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        case = undisturbed(name, folder / "first")
        rng = random.Random(0)
        if times:
            points = [(i, rng.uniform(0, case.seconds)) for i in range(times)]
        else:
            total = 2 * case.operations
            num = min(total, most or total)
            points = [((2 * i + 1) * total // (2 * num), None) for i in range(num)]

        def work(worker: int) -> None:
            with open(folder / f"worker{worker}", "w") as out:
                for point, at_s in itertools.islice(points, worker, None, workers):
                    place = folder / f"point{point}"
                    killed, wrong = try_point(case, point, place, at_s, terminate)
                    print(json.dumps([point, killed, wrong]), file=out, flush=True)

        children = []
        for worker in range(workers):
            child = os.fork()
            if not child:
                with contextlib.suppress(BaseException):
                    work(worker)
                    os._exit(0)
                os._exit(1)
            children.append(child)
        failed = [os.waitpid(child, 0)[1] for child in children]
        lines = [x for i in range(workers) for x in (folder / f"worker{i}").open()]
        rows = [json.loads(line) for line in lines]
    if any(failed) or len(rows) != len(points):
        raise RuntimeError(f"{name}: {len(rows)} of {len(points)} points were tried")
    return {
        "command": name,
        "operations": case.operations,
        "tried": len(rows),
        "killed": sum(row[1] for row in rows),
        "equal": sum(not row[2] for row in rows),
        "wrong": {row[0]: row[2] for row in sorted(rows) if row[2]},
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--commands", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--points", type=int, help="try so many, spread evenly; by default all")
    parser.add_argument("--random", type=int, default=0, help="random times instead of points")
    parser.add_argument("--terminate", action="store_true", help="SIGTERM instead of SIGKILL")
    arguments = parser.parse_args()
    wrong = 0
    for name in arguments.commands:
        found = try_command(name, arguments.points, arguments.random, arguments.terminate)
        print(
            f"{name}: {found['operations']} file operations, {found['tried']} points tried, "
            f"{found['killed']} killed, {found['equal']} equal after the resumed run",
            flush=True,
        )
        for point, text in found["wrong"].items():
            print(f"  point {point}: {text}")
        wrong += len(found["wrong"])
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
