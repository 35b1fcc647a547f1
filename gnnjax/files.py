"""Files that are never half written, and a lock for what one command writes at a time."""

import contextlib
import importlib.metadata
import json
import os
import re
import shlex
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gnnjax.errors import InputError

try:
    import fcntl
except ImportError:  # no POSIX: no locks, and leftovers of killed commands stay
    fcntl = None


def as_json(settings: Any) -> Any:
    """Settings as they are read back from JSON: tuples are lists, paths and the like texts, and
    NumPy's numbers numbers."""

    def plain(value: object) -> Any:
        return value.item() if isinstance(value, np.generic) else str(value)

    return json.loads(json.dumps(settings, default=plain))


def cache_folder(name: str) -> Path:
    """A folder of the user's cache, for what can be computed again; it may not exist yet."""
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "gnnjax" / name


def check_target(path: str | Path) -> Path:
    """Returns the path of a file to be written, or says why no file can have it."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{str(path)!r} is a folder; name a file")
    folder = next(parent for parent in path.parents if parent.exists())
    if not folder.is_dir():
        raise InputError(
            f"{str(path)!r} cannot be made, as {str(folder)!r} is a file; name a folder"
        )
    return path


def check_apart(written: Sequence[Path | None], read: Sequence[str | Path | None] = ()) -> None:
    """Refuses a file that would be written over another one of the same command.

    Args:
        written: files of the command, None where it writes none.
        read: what it reads, which it must not replace, nor files that a JSON of these names.
    """
    if not any(written):
        return
    known = [Path(path) for path in read if path is not None]
    known += [file for path in known for file in _named_in(path)]
    taken = {path.resolve(): "read from" for path in known}
    for path in written:
        if path is None:
            continue
        where = path.resolve()
        if where in taken:
            raise InputError(
                f"{str(path)!r} would be written, and is also {taken[where]}; name another file"
            )
        taken[where] = "written otherwise"


def _named_in(path: Path) -> list[Path]:
    """Files that a JSON file names, from its folder on; whoever reads it tells what is wrong with
    it."""
    if path.suffix.lower() != ".json":
        return []
    found: list[Path] = []

    def look(value: object) -> None:
        if isinstance(value, str) and len(value) < 4096 and "\0" not in value:
            found.append(path.parent / value)
        elif isinstance(value, dict | list):
            for one in value.values() if isinstance(value, dict) else value:
                look(one)

    with contextlib.suppress(OSError, ValueError, RecursionError):
        look(json.loads(path.read_text(encoding="utf-8")))
    return found


def atomic_write(path: str | Path, write: Callable[[Path], object]) -> None:
    """Replaces `path` by what `write` puts into the file it is given, or leaves it untouched.

    The temporary file lies beside the target, so that the final rename stays on one file system
    and a crash or a full disk cannot leave half a file under the final name. What a killed command
    left of the same target is removed.
    """
    path = check_target(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(path)
    handle, temporary = _open_temporary(path)
    try:
        write(temporary)
        os.fsync(handle)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)  # mkstemp makes it private
        os.replace(temporary, path)
    except OSError as error:  # of the temporary file, which the user does not know, or of none
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)
        os.close(handle)


@contextlib.contextmanager
def locked(path: str | Path) -> Iterator[None]:
    """Holds the lock of a target: the file `.NAME.lock` beside it, which names its holder.

    The system takes the lock from a process that dies, however it does.

    Raises:
        InputError: another process holds it.
    """
    path = check_target(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    while True:
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:  # of the lock, which the user does not know
            raise OSError(error.errno, error.strerror, str(path)) from error
        try:
            if not _try_lock(handle):
                holder = os.pread(handle, 1000, 0).decode(errors="replace") or "another process"
                raise InputError(
                    f"{str(path)!r} is being written by {holder}; wait until it ends, or choose "
                    "another place"
                )
            if os.fstat(handle).st_nlink:
                break
            os.close(handle)  # the holder before us has just removed it: make it anew
        except BaseException:
            os.close(handle)
            raise
    try:
        with contextlib.suppress(OSError):  # a full disk is said where something is to be written
            os.ftruncate(handle, 0)
            os.pwrite(handle, _this_process().encode(errors="replace"), 0)
        yield
    finally:
        # First removed, then given free, so that nobody holds a lock that is not there.
        lock.unlink(missing_ok=True)
        os.close(handle)


def _this_process() -> str:
    command = shlex.join([*(Path(word).stem for word in sys.argv[:1]), *sys.argv[1:]])
    began = time.strftime("%Y-%m-%d %H:%M:%S")
    return f"process {os.getpid()} on {socket.gethostname()}, since {began} ({command[:80]})"


def is_leftover(name: str) -> bool:
    """Whether a file is called as `atomic_write` and `locked` call theirs."""
    return re.fullmatch(r"\..*(\.part-[a-z0-9_]{8}(\..*)?|\.lock)", name) is not None


def _open_temporary(path: Path) -> tuple[int, Path]:
    """A new file beside `path`, locked, so that it can be told from that of a killed command."""
    while True:
        # The suffix is kept because NumPy and matplotlib choose the format by it.
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.stem}.part-", suffix=path.suffix
        )
        if _try_lock(handle) and os.fstat(handle).st_nlink:
            return handle, Path(name)
        os.close(handle)  # another process took it for a leftover


def _remove_leftovers(path: Path) -> None:
    stem, suffix = re.escape(path.stem), re.escape(path.suffix)
    pattern = re.compile(rf"\.{stem}\.part-[a-z0-9_]{{8}}{suffix}")
    with os.scandir(path.parent) as entries:
        found = [entry.path for entry in entries if pattern.fullmatch(entry.name)]
    for name in found:
        with contextlib.suppress(OSError):  # in use, of another user, or just removed
            handle = os.open(name, os.O_RDWR)
            try:
                if fcntl is not None:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises if it is in use
                    os.unlink(name)
            finally:
                os.close(handle)


def _try_lock(handle: int) -> bool:
    """Takes a file's lock, unless another process holds it; it ends with the process."""
    if fcntl is not None:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks
            return True
    return True


def code_version() -> str:
    """The version of this package, as files and results name it."""
    try:
        return importlib.metadata.version("gnnjax")
    except importlib.metadata.PackageNotFoundError:  # run from a checkout that is not installed
        return "unknown"
