"""Which files a model is read from, besides the one that is named."""

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias
from xml.parsers import expat

import mujoco

from gnnjax.arm.mesh_files import ends_early
from gnnjax.arm.urdf import find_mesh, parse_xml
from gnnjax.errors import InputError

_DIRS = ("meshdir", "assetdir", "texturedir")  # of MuJoCo's compilers
_MOST = 1000  # files, after which no further ones are looked for: they may include each other
Written: TypeAlias = tuple[tuple[str, int, int], ...]  # files, when (ns) and how much (bytes)
_SEEN: dict[str, tuple[list[Path], Written]] = {}  # by path, what was found


def sources(path: Path) -> list[Path]:
    """An MJCF or URDF, and all that it includes, attaches or has meshes, height fields and pictures
    from, as far as it is there.

    MuJoCo says of no file where it found it. So of an MJCF it may be one file of several that are
    called alike, in folders where it could look; then all of them are listed.
    """
    texts, named, folders = [path], [], [""]
    for text in texts:
        try:
            root = parse_xml(text.read_bytes())
        except (expat.ExpatError, LookupError, OSError, ValueError):  # whoever reads it says so
            continue
        for element in root.iter():
            folders += [element.get(key, "") for key in _DIRS]
            files = [x for key, x in element.items() if key.startswith("file") and x]
            if element.tag in ("include", "model"):
                inner = _there(files, texts, [""])
                texts += [x for x in inner if x not in texts][: _MOST - len(texts)]
            else:
                named += files
    if path.suffix != ".urdf":
        return [*texts, *_there(dict.fromkeys(named), texts, list(dict.fromkeys(folders)))]
    meshes = []
    for name in dict.fromkeys(named):
        try:
            meshes.append(find_mesh(name, [path.parent / x for x in dict.fromkeys(folders)], path))
        except InputError:  # of what it only looks like; or whoever reads it says so
            continue
    return [path, *meshes]


def sources_sha256(path: Path) -> str:
    """Checksum of all that `sources` lists: another one once any of it is edited."""
    sums = [hashlib.sha256(file.read_bytes()).digest() for file in sources(path)]
    return hashlib.sha256(b"".join(sums)).hexdigest()


def _there(names: Iterable[str], texts: list[Path], folders: list[str]) -> list[Path]:
    """Files of these names, in the folders of texts and those that they name."""
    tried = (
        text.parent / folder / x
        for name in names
        for x in (name, Path(name).name)
        for text in texts
        for folder in folders
    )
    return [file for file in dict.fromkeys(tried) if os.path.isfile(file)]


def check_meshes(path: Path) -> None:
    """Refuses meshes of an MJCF that end too early, of which MuJoCo takes what there is, and has it
    read the others: it keeps meshes by the second of their last edit, where two may be.

    Raises:
        InputError: there is one.
    """
    mujoco.mj_clearCache(mujoco.mj_getCache())
    for file in sources(path):
        if ends_early(file):
            raise InputError(f"mesh {str(file)!r} of {str(path)!r} ends too early; export it again")


def written(path: Path) -> Written:
    """When all files of a model were written, and how long they are: it changes once one of them is
    edited. Where none is, this takes a system call each."""
    called = os.path.abspath(path)
    files, before = _SEEN.get(called, ([], ()))
    if not before or _stats(files) != before:
        files = sources(path)
        before = _stats(files)
        _SEEN[called] = files, before
    return before


def _stats(files: list[Path]) -> Written:
    found = []
    for file in files:
        try:
            state = os.stat(file)
            found.append((os.path.abspath(file), state.st_mtime_ns, state.st_size))
        except (OSError, ValueError):
            found.append((str(file), -1, -1))
    return tuple(found)
