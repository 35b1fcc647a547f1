"""What readers of meshes leave to others: whether files are whole, and in which unit.

Of text that ends too early, readers take what there is.
"""

import contextlib
import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path

from gnnjax.errors import InputError, brief

# Whole last lines of an OBJ, of those that have numbers; a corner is 7, 7/7, 7//7 or 7/7/7.
_CORNER = rb"\s+-?\d+(/-?\d+|/-?\d*/-?\d+)?"
_NUMBER = rb"\s+[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
_LAST = {
    b"f": re.compile(_CORNER * 3 + rb"(%b)*\s*" % _CORNER),
    b"v": re.compile(_NUMBER * 3 + rb"(%b)*\s*" % _NUMBER),
}
_RELATIVE = re.compile(rb"^[ \t]*f[ \t](?:[^\r\n]*[ \t])?(?:-\d|0+(?![0-9]))", re.MULTILINE)


def ends_early(file: Path) -> bool:
    """Whether a PLY, OFF or STL of text has fewer vertices and faces than it says, or no end, or an
    OBJ ends within a vertex or face.

    Of OBJ no more can be told: it does not say how long it is, and one that is cut off between two
    lines, or in the last digits of a number, is a whole file with fewer faces. Readers find out
    about corners that are not there, and about other formats, themselves.
    """
    ending = file.suffix.lower()
    if ending not in (".ply", ".off", ".stl", ".obj"):
        return False
    data = file.read_bytes()
    rows = [row for row in data.split(b"\n") if row.strip() and not row.lstrip().startswith(b"#")]
    with contextlib.suppress(ValueError, IndexError):  # no such file, as its reader says
        if ending == ".ply" and any(row.split() == b"format ascii 1.0".split() for row in rows):
            header = [row.split()[0] for row in rows].index(b"end_header") + 1
            counts = [row.split()[2] for row in rows[:header] if row.startswith(b"element ")]
            return len(rows) - header < sum(map(int, counts))
        if ending == ".obj":
            last = rows[-1].partition(b"#")[0].strip()
            word = last.split()[0]
            return word in _LAST and not _LAST[word].fullmatch(last[len(word) :])
        if ending == ".off":
            first = 0 if len(rows[0].split()) > 1 else 1  # the counts may follow on the first line
            counts = rows[first].split()[-3:-1]
            return len(rows) - first - 1 < sum(map(int, counts))
        if ending == ".stl" and rows[0].startswith(b"solid") and b"facet" in rows[1]:
            return not rows[-1].lstrip().startswith(b"endsolid")
    return False


def counts_back(file: Path) -> bool:
    """Whether an OBJ names corners of faces as so many before, which trimesh takes for so many
    before the last one of the file, or by 0, which there is not."""
    return file.suffix.lower() == ".obj" and bool(_RELATIVE.search(file.read_bytes()))


def unit_of(file: Path) -> float:
    """Metres of the unit that a COLLADA file names, which trimesh leaves as it is; 1 of others.

    Raises:
        InputError: it is no length.
    """
    if file.suffix.lower() != ".dae":
        return 1.0
    unit = ET.parse(file).getroot().find("{*}asset/{*}unit")
    named = "1" if unit is None else unit.get("meter", "1")
    with contextlib.suppress(ValueError):
        if 0 < float(named) < math.inf:
            return float(named)
    raise InputError(f"mesh {str(file)!r} is in units of {brief(named)} m; give a length")
