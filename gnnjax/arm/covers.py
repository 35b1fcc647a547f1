"""Covers: the spheres that the fast tests have in place of an arm's parts.

A part that is a sphere is its own cover, and a capsule a chain. Others get spheres (`fit.py`),
which takes a second or two a part; so covers are kept in the user's cache folder, each as soon as
it is there.
"""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnnjax.arm.fit import Cover, fit_covers
from gnnjax.arm.parts import Part
from gnnjax.array_files import FileKind, read_arrays
from gnnjax.errors import InputError
from gnnjax.files import atomic_write, cache_folder

_LOG = logging.getLogger(__name__)

OVERSHOOT = 0.015  # m; a part whose spheres reach no further out of it has enough of them
_MOST = 12  # spheres of a part
_MOST_OF_ALL, _MOST_EACH = (
    60,
    3,
)  # spheres of an arm, or of its parts in the mean, if these are many
_SAME = 1e-6  # m; by which hulls that are taken for the same may differ
_SPHERES = FileKind("file of spheres", "those of an arm", "remove that file")
_VERSION = 1  # of the fit; covers of another one are fitted anew


class Rows(NamedTuple):
    """The spheres of all parts, as `Robot` has them."""

    parts: np.ndarray  # [G] index of the part that each belongs to
    centers: np.ndarray  # [G 3] m
    radii: np.ndarray  # [G] m
    inner_radii: np.ndarray  # [G] m, of the ball about the same centre that is inside the part


def cover_parts(parts: Sequence[Part], kept: Path | None = None) -> Rows:
    """Covers parts by spheres, in their order: round ones by themselves or a chain.

    Args:
        parts: of an arm.
        kept: file of `save_cover`, whose spheres are taken if it is there and of these parts.
    """
    angular = [part for part in parts if len(part.vertices) > 2]
    covers = iter(_read_cover(kept, angular) or _share(_fitted(angular)))
    rows = []
    for number, part in enumerate(parts):
        cover = next(covers) if len(part.vertices) > 2 else chain_cover(part)
        rows += [(number, *sphere) for sphere in zip(*cover, strict=True)]
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Rows(*columns)


def chain_cover(part: Part) -> Cover:
    """A sphere as it is, or a capsule as spheres along its axis, at most a radius apart."""
    first, last = part.vertices[[0, -1]]
    pieces = int(np.ceil(np.linalg.norm(last - first) / part.radius)) if part.radius > 0 else 0
    share = np.linspace(0, 1, pieces + 1)[:, None] if pieces else np.full((1, 1), 0.5)
    centers = first + share * (last - first)
    apart = np.linalg.norm(last - first) / max(pieces, 1)
    radius = np.hypot(part.radius, apart / 2) if pieces else part.radius
    num = len(centers)
    return Cover(centers, np.full(num, radius), np.full(num, part.radius))


def pairs_of_spheres(sphere_parts: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Pairs `[S 2]` of spheres, those of pairs of parts, in order.

    Args:
        sphere_parts: `[G]` part of each sphere.
        pairs: `[Q 2]` of parts.
    """
    of_part = [np.flatnonzero(sphere_parts == number) for number in range(1 + sphere_parts.max())]
    rows = [
        np.sort(np.stack(np.meshgrid(of_part[a], of_part[b]), axis=-1).reshape(-1, 2), axis=1)
        for a, b in pairs.tolist()
    ]
    rows = np.concatenate([np.empty((0, 2), np.int64), *rows])
    return rows[np.lexsort(rows.T[::-1])]


def cover_file(path: Path) -> Path:
    """Where spheres are kept beside an arm's file."""
    return path.with_name(f"{path.stem}_cover.npz")


def save_cover(file: Path, parts: Sequence[Part], rows: Rows) -> None:
    """Writes the spheres of the parts that are not round, for `cover_parts`."""
    arrays = {}
    for number, part in enumerate(parts):
        if len(part.vertices) > 2:
            own = rows.parts == number
            table = np.column_stack([rows.centers, rows.radii, rows.inner_radii])[own]
            arrays[part.name], arrays[f"{part.name}/hull"] = table, _summary(part)

    def write(out: Path) -> None:
        with open(out, "wb") as stream:
            np.savez_compressed(stream, **arrays)

    atomic_write(file, write)


def _read_cover(file: Path | None, parts: Sequence[Part]) -> list[Cover]:
    """The covers in a file, or none where there is none or it is of other parts."""
    if file is None or not file.is_file():
        return []
    arrays, covers = read_arrays(file, _SPHERES), []
    for part in parts:
        table, hull = arrays.get(part.name), arrays.get(f"{part.name}/hull")
        expected = _summary(part)
        if table is None or hull is None or hull.shape != expected.shape:
            return []
        if np.abs(hull - expected).max() > _SAME or table.ndim != 2 or table.shape[1] != 5:
            return []
        # A little larger, for what may differ between machines.
        cover = Cover(table[:, :3], table[:, 3] + _SAME, table[:, 4] - _SAME)
        apart = np.linalg.norm(part.vertices[:, None] - cover.centers, axis=-1) + part.radius
        if not (apart <= cover.radii).any(axis=1).all():
            raise InputError(
                f"the spheres of {part.name} in {str(file)!r} do not enclose it; remove that file"
            )
        covers.append(cover)
    return covers


def _summary(part: Part) -> np.ndarray:
    """What tells a hull from another one."""
    corners = part.vertices
    moments = (corners - corners.mean(axis=0)).T @ (corners - corners.mean(axis=0)) / len(corners)
    ends = corners.min(axis=0), corners.max(axis=0), corners.mean(axis=0)
    return np.concatenate([*ends, np.sqrt(np.abs(moments.ravel())), [part.radius, len(corners)]])


def _share(choices: list[list[Cover]]) -> list[Cover]:
    """Chooses a cover of each part: spheres go to where they reach out furthest."""
    chosen = [0] * len(choices)
    left = max(_MOST_OF_ALL, _MOST_EACH * len(choices)) - sum(len(x[0].radii) for x in choices)
    while True:
        better = [
            (choices[i][k].overshoot, len(choices[i][k + 1].radii) - len(choices[i][k].radii), i)
            for i, k in enumerate(chosen)
            if k + 1 < len(choices[i]) and choices[i][k].overshoot > OVERSHOOT
        ]
        better = [(over, cost, i) for over, cost, i in better if cost <= left]
        if not better:
            return [covers[k] for covers, k in zip(choices, chosen, strict=True)]
        _, cost, i = max(better)
        chosen[i] += 1
        left -= cost


def _fitted(parts: list[Part]) -> list[list[Cover]]:
    """Covers of each part, of one sphere and more, from the cache or fitted."""
    files = [_file(part) for part in parts]
    found = [_read(file) for file in files]
    missing = [i for i, covers in enumerate(found) if not covers]
    if not missing:
        return found
    from rich.console import Console

    from gnnjax.progress_bar import progress_bar

    console = Console(stderr=True)
    # Elsewhere than in a terminal a bar that goes away would leave an empty line.
    with progress_bar(console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=len(missing))
        for i in missing:
            progress.update(task, description=f"fitting spheres to {parts[i].name}, once")
            found[i] = [
                Cover(fit.centers, fit.radii + parts[i].radius, fit.depths + parts[i].radius)
                for fit in fit_covers(parts[i].vertices, overshoot=OVERSHOOT, most=_MOST)
            ]
            _save(files[i], found[i])
            progress.advance(task)
    return found


def _file(part: Part) -> Path:
    key = hashlib.sha256(np.ascontiguousarray(part.vertices, float).tobytes())
    key.update(repr((_VERSION, part.radius, OVERSHOOT, _MOST)).encode())
    return cache_folder("covers") / f"{key.hexdigest()[:32]}.npy"


def _read(file: Path) -> list[Cover]:
    """Covers that were kept, or none where there are none that can be read."""
    try:
        table = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError):  # not there, or damaged: they are fitted anew
        return []
    if table.ndim != 2 or table.shape[1] != 6 or not np.isfinite(table).all():
        return []
    covers = [table[table[:, 0] == number, 1:] for number in np.unique(table[:, 0])]
    return [Cover(rows[:, :3], rows[:, 3], rows[:, 4]) for rows in covers]


def _save(file: Path, covers: list[Cover]) -> None:
    tables = [
        np.column_stack([np.full(len(x.radii), number), x.centers, x.radii, x.depths])
        for number, x in enumerate(covers)
    ]
    try:
        atomic_write(file, lambda part: np.save(part, np.concatenate(tables)))
    # A full disk, a folder of somebody else, a file in its place: they are fitted again then.
    except (OSError, InputError) as error:
        _LOG.warning("spheres are not kept in %s: %s", file.parent, error)
