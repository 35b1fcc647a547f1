"""Files of results: one of all rows, and those of some rows each that several processes write."""

import contextlib
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from gnnjax.errors import InputError, brief
from gnnjax.files import atomic_write
from gnnjax.measure.rows import ROW
from gnnjax.roll_call import Place

# Of the result files; raised when what they hold changes its meaning.
FORMAT = 2

OF_ARM = ("robot", "joints", "hold", "allow", "attach", "rest_share")  # settings that say which

# Rows of a file that a process writes at once, at most; of a small set, there are about so many.
_MOST_ROWS, _FILES = 1024, 256


def write_results(path: Path, results: dict[str, Any]) -> None:
    """Writes results as JSON, or leaves what is there."""
    text = json.dumps(results, allow_nan=False)
    atomic_write(path, lambda file: file.write_text(text + "\n", encoding="utf-8"))


def read_results(path: Path, *, rows: bool = True) -> dict[str, Any]:
    """Finished results, with their rows unless these are not asked for.

    Raises:
        InputError: another file, results that are not complete, or that have their rows elsewhere.
    """
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
        version, complete, held = (results[key] for key in ("format", "complete", "problems"))
        if version == FORMAT:
            _check_rows(held, 0)
    except FileNotFoundError:
        raise InputError(f"no results {str(path)!r}; gnnjax.evaluate writes such") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{str(path)!r} holds no results; gnnjax.evaluate writes such") from None
    faults = {
        "of another version": version != FORMAT,
        "that were cut off": not complete,
        "without rows": rows and not held,
    }
    for fault, found in faults.items():
        if found:
            how = ", without --keep-parts" if "parts" in results else ""
            raise InputError(f"{str(path)!r} holds results {fault}; run gnnjax.evaluate again{how}")
    return results


def read_rows(
    path: Path, settings: dict[str, Any], defaults: dict[str, Any], first: int = 0
) -> list[dict]:
    """The rows that an earlier run with the same settings has in its file; none where it is not.

    Args:
        path: of the file.
        settings: that it must have.
        defaults: of settings, for files from before one was there.
        first: number of the problem of the first row.

    Raises:
        InputError: another file, or other settings.
    """
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        version, theirs = earlier["format"], dict(earlier["settings"])
        rows = list(earlier["problems"])
        if version == FORMAT:
            _check_rows(rows, first)
    except FileNotFoundError:
        return []
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(
            f"{str(path)!r} exists and holds no results; remove it, or choose another --json"
        ) from None
    if version != FORMAT:
        raise InputError(
            f"{str(path)!r} holds results of format {brief(version)}, this version writes "
            f"{FORMAT}; choose another --json"
        )
    # A file from before an option was there has none of it, which is what its default says.
    theirs = defaults | theirs
    for name, value in settings.items():
        if theirs.get(name) != value:
            raise InputError(
                f"{str(path)!r} holds results with {name} {brief(theirs.get(name))}, not "
                f"{brief(value)}; "
                "choose another --json"
            )
    return rows


def _check_rows(rows: list[dict], first: int) -> None:
    """Raises where rows are not those of the problems from `first` on."""
    if [row["index"] for row in rows] != list(range(first, first + len(rows))):
        raise ValueError("a row is missing")
    if not all(row.keys() >= ROW for row in rows):
        raise ValueError("a row lacks quantities")


class RowFiles:
    """A folder of the rows of `num` problems, in files of whole batches.

    Which rows are in which file does not depend on who writes it.

    Args:
        folder: need not be there.
        num: of all problems.
        batch_size: of them.
        whole: rows of the first problems that are known without the files.
        read: `(file, first) -> rows`, which are those of the problems from `first` on.
    """

    def __init__(
        self,
        folder: Path,
        num: int,
        batch_size: int,
        whole: list[dict],
        read: Callable[[Path, int], list[dict]],
    ):
        self._folder, self._whole, self._read = folder, whole, read
        batches = min(num // (batch_size * _FILES), _MOST_ROWS // batch_size)
        size = batch_size * max(1, batches)
        self.bounds = [(first, min(first + size, num)) for first in range(0, num, size)]
        self.files = [folder / f"rows_{index:05d}.json" for index in range(len(self.bounds))]

    def rows(self, index: int) -> list[dict]:
        """Those of a file; none where they are missing."""
        first, last = self.bounds[index]
        if last <= len(self._whole):
            return self._whole[first:last]
        return self._read(self.files[index], first)

    def missing(self, place: Place) -> list[int]:
        """The files of a process that are not there."""
        numbers = [index for index in range(len(self.files)) if place.has(index)]
        sizes = {i: self.bounds[i][1] - self.bounds[i][0] for i in numbers}
        return [i for i in numbers if len(self.rows(i)) < sizes[i]]

    def remove(self) -> None:
        """Takes the files away, and the folder if there is nothing else in it."""
        for file in self.files:
            file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._folder.rmdir()


def names_of(paths: Iterable[Path]) -> dict[Path, str]:
    """What results are called: by the file's name without its ending, and as many folders before
    that as tell it from the others. The same file, named twice, has one name."""
    whole = {path: Path(os.path.abspath(path)) for path in paths}
    names = {}
    for path, place in whole.items():
        parts = place.with_suffix("").parts
        others = [x.with_suffix("").parts for x in whole.values() if x != place]
        for count in range(1, len(parts) + 1):
            if all(x[-count:] != parts[-count:] for x in others):
                names[path] = Path(*parts[-count:]).as_posix()
                break
        else:  # another ending tells them apart
            names[path] = place.as_posix()
    return names
