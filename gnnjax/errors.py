"""Errors that a person can act on, and files that are never half written."""

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn


class InputError(ValueError):
    """Bad input: one sentence that names the value and the remedy.

    Commands print it as a single line and exit with status 2; library users catch it as a
    `ValueError`.
    """


def run_command(main: Callable[[], int | None]) -> NoReturn:
    """Runs a command's `main` and exits with its status, without a traceback for bad input."""
    try:
        status = main() or 0
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        status = 2
    except KeyboardInterrupt:
        print("interrupted; start the same command again to go on", file=sys.stderr)
        status = 130
    except OSError as error:  # disk full, permission denied, a folder that is missing
        print(f"error: {error.strerror or error}: {error.filename or ''}", file=sys.stderr)
        status = 2
    sys.exit(status)


def atomic_write(path: str | Path, write: Callable[[Path], object]) -> None:
    """Replaces `path` by what `write` puts into the file it is given, or leaves it untouched.

    The temporary file lies beside the target, so that the final rename stays on one file system
    and a crash or a full disk cannot leave half a file under the final name.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix is kept because NumPy and matplotlib choose the format by it.
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)  # mkstemp makes it private
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
