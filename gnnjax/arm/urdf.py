"""URDF files: handed to MuJoCo's own reader in a form that it takes.

Visual geometry is left out, and the meshes of the rest are found, read and given along: MuJoCo
knows neither `package://` nor text STL, and takes no more than 200,000 faces. What it cannot
read is given as its convex hull, which is what MuJoCo collides a mesh as.
"""

import contextlib
import struct
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

import mujoco
import numpy as np

from gnnjax.arm.mesh_files import ends_early, unit_of
from gnnjax.errors import InputError

_MOST_FACES = 200_000  # of MuJoCo's STL reader
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("color", "<u2")])
# Bodies keep their names, and links without masses, which are many, get a gram: planning needs
# none, and MuJoCo refuses a joint that moves nothing.
_COMPILER = {
    "strippath": "false",
    "fusestatic": "false",
    "discardvisual": "true",
    "balanceinertia": "true",
    "boundmass": "1e-3",
    "boundinertia": "1e-6",
}
_MOVING = ("revolute", "continuous", "prismatic")  # joints that others can mimic
# What may limit a joint besides its range and effort, and how URDFs write it.
_LIMITS = {"velocity": ("velocity",), "acceleration": ("acceleration", "drake:acceleration")}


class Urdf(NamedTuple):
    """What a URDF holds."""

    spec: mujoco.MjSpec
    limits: dict[str, dict[str, float]]  # "velocity", "acceleration": by joint, rad or m, and s
    no_room: dict[str, tuple[float, float]]  # ranges that leave a joint none, which MuJoCo drops
    notes: list[str]  # what there is to be said about it


def read_urdf(path: Path) -> Urdf:
    """Reads a URDF.

    Raises:
        InputError: it is no URDF, or a mesh is missing or cannot be read.
        ValueError: MuJoCo cannot read it.
    """
    try:
        root = parse_xml(path.read_bytes())
    except expat.ExpatError as error:
        raise InputError(f"{str(path)!r} is no XML: {error}; check the file") from None
    if root.tag != "robot":
        raise InputError(f"{str(path)!r} begins with <{root.tag}>; a URDF begins with <robot>")
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        raise InputError(
            f"{str(path)!r} holds xacro macros; expand them first (xacro FILE.xacro > FILE.urdf)"
        )
    _check_joints(root, path)
    folders = [path.parent]
    for element in root.findall("mujoco"):
        folders += [path.parent / x.get("meshdir", "") for x in element.findall("compiler")]
        root.remove(element)
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", _COMPILER)
    assets: dict[str, bytes] = {}
    names: dict[tuple[Path, str], str] = {}
    notes = []
    bare = not any(link.find("collision") is not None for link in root.findall("link"))
    if bare and root.find("link/visual") is not None:
        notes.append("no link has collision geometry; what they look like is taken for it")
    for link in root.findall("link"):
        _mend_inertia(link)
        for visual in link.findall("visual"):
            if bare:
                visual.tag = "collision"
            else:
                link.remove(visual)
        for mesh in link.iter("mesh"):
            file = find_mesh(mesh.get("filename", ""), folders, path)
            scale = mesh.get("scale", "1 1 1")
            if (file, scale) not in names:
                ending, data = _load(file)
                names[file, scale] = f"mesh_{len(names)}{ending}"
                assets[names[file, scale]] = data
            mesh.set("filename", names[file, scale])
    for limit in root.iterfind("joint/limit"):
        limit.attrib = {name: value for name, value in limit.attrib.items() if value.strip()}
        if {"lower", "upper"} & limit.attrib.keys():  # of one alone MuJoCo makes no limits
            limit.attrib = {"lower": "0", "upper": "0", **limit.attrib}
    limits = {kind: _limits(root, names) for kind, names in _LIMITS.items()}
    text = ET.tostring(root, encoding="unicode")
    return Urdf(mujoco.MjSpec.from_string(text, assets=assets), limits, _no_room(root), notes)


def parse_xml(data: bytes) -> ET.Element:
    """The root of an XML file. Prefixes are a part of names: URDFs have them without saying what
    they stand for, which those who read URDFs take, and XML's own readers do not."""
    tree, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = tree.start, tree.end
    parser.CharacterDataHandler = tree.data
    parser.Parse(data, True)
    return tree.close()


def _limits(root: ET.Element, names: tuple[str, ...]) -> dict[str, float]:
    """A limit of the joints that have it, by their names; `names` are those of the limit."""
    found = {}
    for joint in root.findall("joint"):
        for limit in joint.findall("limit"):
            word = next((limit.get(name) for name in names if limit.get(name)), "")
            with contextlib.suppress(ValueError):  # a word in place of a number is no limit
                if 0 < float(word) < np.inf:
                    found[joint.get("name", "")] = float(word)
    return found


def _no_room(root: ET.Element) -> dict[str, tuple[float, float]]:
    """Lower and upper limits of joints that have no room between them, by their names."""
    found = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if joint.get("type") in ("revolute", "prismatic") and limit is not None:
            with contextlib.suppress(ValueError):
                lower, upper = (float(limit.get(side, "nan")) for side in ("lower", "upper"))
                if lower >= upper:
                    found[joint.get("name", "")] = lower, upper
    return found


def _check_joints(root: ET.Element, path: Path) -> None:
    """Refuses joints of one name, and those that mimic none of the joints, or one that does not
    move, which MuJoCo takes for joints of their own."""
    kinds: dict[str | None, str | None] = {}
    for joint in root.findall("joint"):
        name = joint.get("name")
        if name in kinds:
            raise InputError(f"{str(path)!r} has two joints {name!r}; rename one of them")
        kinds[name] = joint.get("type")
    for joint in root.findall("joint"):
        for mimic in joint.findall("mimic"):
            named = mimic.get("joint")
            if kinds.get(named) not in _MOVING:
                what = f"is {kinds[named]} and moves nothing" if named in kinds else "is not there"
                raise InputError(
                    f"joint {joint.get('name')} of {str(path)!r} mimics {named!r}, which {what}; "
                    "name one of its joints that move, or take <mimic> out"
                )


def _mend_inertia(link: ET.Element) -> None:
    """Makes an inertia that no body can have, which MuJoCo refuses, one of a ball."""
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return
    try:
        xx, yy, zz, xy, xz, yz = (
            float(inertia.get(name, "0")) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        )
    except ValueError:  # no number: MuJoCo says so
        return
    if np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).min() <= 0:
        mean = f"{max((xx + yy + zz) / 3, 1e-6):.6g}"
        inertia.attrib = {"ixx": mean, "iyy": mean, "izz": mean, "ixy": "0", "ixz": "0", "iyz": "0"}


def find_mesh(name: str, folders: list[Path], urdf: Path) -> Path:
    """The file that a URDF calls `name`.

    What stands after `package://PACKAGE/` lies in a folder called PACKAGE above the URDF or beside
    one that is above it, as in any checkout of the package.
    """
    above = [folder.resolve() for folder in urdf.resolve().parents]
    scheme, _, rest = name.rpartition("://")
    if scheme in ("package", "model"):
        package, _, inside = rest.partition("/")
        tried = [folder / inside for folder in above if folder.name == package]
        tried += [folder / package / inside for folder in above]
        tried += [folder / inside for folder in above[:4]]  # a package in a folder called otherwise
    elif scheme in ("", "file"):
        tried = [folder / rest for folder in folders]
        tried += [folder / Path(rest).name for folder in folders]
    else:
        raise InputError(f"mesh {name!r} of {str(urdf)!r} is on no disk; save it beside the URDF")
    for file in tried:
        if file.is_file():
            return file
    raise InputError(
        f"mesh {name!r} of {str(urdf)!r} is not there, nor at {str(tried[0])!r}; put it where the "
        "URDF says, packages beside or above the URDF's folder"
    )


def _load(file: Path) -> tuple[str, bytes]:
    """A mesh as MuJoCo reads it: the ending of its name, and its bytes."""
    ending = file.suffix.lower()
    data = file.read_bytes()
    if ends_early(file):
        raise InputError(f"mesh {str(file)!r} ends too early; export it again")
    if ending == ".obj":
        return ending, data
    if ending == ".stl":
        (count,) = struct.unpack_from("<I", data, 80) if len(data) >= 84 else (0,)
        size = 84 + count * _STL_FACE.itemsize
        text = data[:2000].lower()
        if len(data) != size and text.lstrip().startswith(b"solid") and b"vertex" in text:
            return ".stl", _hull_stl(_text_stl(data.lower(), file), file)
        if len(data) < size:
            raise InputError(f"mesh {str(file)!r} ends too early for an STL; export it again")
        if len(data) == size and 0 < count <= _MOST_FACES:
            return ".stl", data
        faces = np.frombuffer(data, _STL_FACE, count, 84) if count else np.empty(0, _STL_FACE)
        return ".stl", _hull_stl(faces["corners"].reshape(-1, 3), file)
    return ".stl", _hull_stl(_by_trimesh(file), file)


def _text_stl(data: bytes, file: Path) -> np.ndarray:
    """The corners [N 3] of a text STL."""
    words = [line.split() for line in data.split(b"\n")]
    try:
        return np.array([line[1:4] for line in words if line[:1] == [b"vertex"]], float)
    except ValueError:
        raise InputError(f"mesh {str(file)!r} is no STL; export it again") from None


def _by_trimesh(file: Path) -> np.ndarray:
    """The vertices [N 3] of a mesh in another format."""
    try:
        import trimesh
    except ImportError:
        raise InputError(
            f"mesh {str(file)!r} is neither STL nor OBJ; convert it, or install what can read it "
            "(pip install trimesh pycollada)"
        ) from None
    try:
        mesh = trimesh.load(str(file), force="mesh", process=False)
    except Exception as error:  # each of its readers raises its own
        raise InputError(f"mesh {str(file)!r} cannot be read: {error}; make it an STL") from None
    return np.asarray(mesh.vertices, float) * unit_of(file)


def _hull_stl(points: np.ndarray, file: Path) -> bytes:
    """The convex hull of points [N 3], as an STL.

    Raises:
        InputError: there are no points, or they have no volume.
    """
    from scipy.spatial import ConvexHull, QhullError  # half a second, for such meshes alone

    if not len(points):
        raise InputError(f"mesh {str(file)!r} is empty; export it again")
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        raise InputError(
            f"mesh {str(file)!r} is flat or not finite; give it a volume, or use a box"
        ) from None
    triangles = points[hull.simplices]
    # Outwards, as MuJoCo demands.
    a, b, c = triangles.swapaxes(0, 1)
    inwards = np.einsum("fk,fk->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles[inwards] = triangles[inwards, ::-1]
    faces = np.zeros(len(triangles), _STL_FACE)
    faces["corners"] = triangles
    return bytes(80) + struct.pack("<I", len(faces)) + faces.tobytes()
