"""Whether files of meshes are whole. Of text that ends too early, readers take what there is."""

import contextlib
from pathlib import Path


def ends_early(file: Path) -> bool:
    """Whether a PLY, OFF or STL of text has fewer vertices and faces than it says, or no end.

    Readers find out about other formats themselves, but for OBJ, which says nothing.
    """
    ending = file.suffix.lower()
    if ending not in (".ply", ".off", ".stl"):
        return False
    data = file.read_bytes()
    rows = [row for row in data.split(b"\n") if row.strip() and not row.lstrip().startswith(b"#")]
    with contextlib.suppress(ValueError, IndexError):  # no such file, as its reader says
        if ending == ".ply" and any(row.split() == b"format ascii 1.0".split() for row in rows):
            header = [row.split()[0] for row in rows].index(b"end_header") + 1
            counts = [row.split()[2] for row in rows[:header] if row.startswith(b"element ")]
            return len(rows) - header < sum(map(int, counts))
        if ending == ".off":
            first = 0 if len(rows[0].split()) > 1 else 1  # the counts may follow on the first line
            counts = rows[first].split()[-3:-1]
            return len(rows) - first - 1 < sum(map(int, counts))
        if ending == ".stl" and rows[0].startswith(b"solid") and b"facet" in rows[1]:
            return not rows[-1].lstrip().startswith(b"endsolid")
    return False
