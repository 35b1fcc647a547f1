"""Files of arrays: `.npz` without pickles, read so that a damaged one is named."""

import math
import warnings
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnnjax.errors import InputError


class FileKind(NamedTuple):
    """How messages speak of a kind of files."""

    name: str  # what one is called
    content: str  # what it should hold
    remedy: str  # what to do about one that does not


def read_arrays(path: Path, kind: FileKind) -> dict[str, np.ndarray]:
    """Reads all arrays of a file, an `.npz` without pickles.

    Args:
        path: of the file.
        kind: for messages.

    Raises:
        InputError: no such file, or something in it is no array.
    """
    name = None
    arrays = {}
    try:
        # Not np.load, which takes any other file for a pickle and advises to trust it.
        with open(path, "rb") as stream, zipfile.ZipFile(stream) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                if name in arrays:  # of two, one would be left out
                    raise ValueError("it is there twice")
                arrays[name] = _read_array(archive, entry)
    except FileNotFoundError:
        raise InputError(f"no {kind.name} {str(path)!r}; check the path") from None
    except IsADirectoryError:
        raise InputError(f"{kind.name} {str(path)!r} is a folder; check the path") from None
    except (PermissionError, MemoryError):
        raise
    except Exception as error:  # damaged archives raise nearly anything
        part = "" if name is None else f"array {name!r} of "
        raise InputError(
            f"{part}{str(path)!r} cannot be read as {kind.content} (.npz without pickles): "
            f"{error}; {kind.remedy}"
        ) from None
    return arrays


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """Reads an array, for which memory is asked only if the file can fill it."""
    with archive.open(entry) as file, warnings.catch_warnings():
        warnings.simplefilter("error")  # of old or odd headers
        try:
            read = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[np.lib.format.read_magic(file)]
            shape, _, dtype = read(file)
        except (KeyError, MemoryError, RecursionError):  # what a header of brackets raises
            raise ValueError("its header is no array's") from None
        if dtype.hasobject:
            raise ValueError("it holds Python objects")
        promised, given = math.prod(shape) * dtype.itemsize, entry.file_size - file.tell()
        if promised != given or min(shape, default=0) < 0:
            raise ValueError(f"its header promises {promised} bytes, and there are {given}")
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)
