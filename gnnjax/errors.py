"""Errors that a person can act on, and files that are never half written."""

import errno
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import jax

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
        named = f"{error.strerror}: {error.filename}" if error.filename else str(error)
        remedy = _REMEDIES.get(error.errno or 0, "check the path")
        print(f"error: {named}; {remedy}", file=sys.stderr)
        status = 2
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        reason = " ".join(str(error).split())
        print(f"error: not enough memory; ask for fewer nodes ({reason})", file=sys.stderr)
        status = 2
    sys.exit(status)


def check_seed(seed: int) -> int:
    """Returns a seed that JAX can take, or says that it cannot."""
    if not 0 <= seed < 2**31:
        raise InputError(f"seed is {seed}; choose 0 to {2**31 - 1}")
    return seed


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


def atomic_write(path: str | Path, write: Callable[[Path], object]) -> None:
    """Replaces `path` by what `write` puts into the file it is given, or leaves it untouched.

    The temporary file lies beside the target, so that the final rename stays on one file system
    and a crash or a full disk cannot leave half a file under the final name.
    """
    path = check_target(path)
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
    except OSError as error:  # of the temporary file, which the user does not know, or of none
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)
