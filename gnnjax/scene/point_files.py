"""The files that points and meshes are read from."""

from pathlib import Path
from typing import Any

import numpy as np

from gnnjax.arm.mesh_files import counts_back, ends_early
from gnnjax.array_files import FileKind, read_arrays
from gnnjax.errors import InputError

_ARRAYS = FileKind("file of points", "points", "save it anew by numpy.savez")
_TYPES = {"F": "f", "U": "u", "I": "i"}  # of PCD's numbers, as NumPy calls them


def points_from_file(path: str | Path) -> np.ndarray:
    """Points `[K, 3]` of a .npy, .npz (`points`, or its one array), .pcd or .ply file.

    Points with NaN, by which depth cameras say that they saw nothing, are left out. The VIEWPOINT
    of a .pcd, from where they were seen, moves none of them: PCL's and Open3D's loaders leave them
    as they stand, too, and some writers give them in the sensor's frame, others in the world's. Who
    has them in the sensor's (`pcl_transform_from_viewpoint`) moves them to the base of the arm.

    Raises:
        InputError: no such file, or none that holds points.
    """
    file = Path(path)
    called = f"file of points {str(path)!r}"
    if not file.is_file():
        raise InputError(f"no {called}; check the path")
    ending = file.suffix.lower()
    if ending == ".pcd":
        points = _read_pcd(file, called)
    elif ending == ".npy":
        try:
            points = np.load(file, allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise InputError(f"{called} cannot be read ({error}); save it by numpy.save") from None
    elif ending == ".npz":
        arrays = read_arrays(file, _ARRAYS)
        if "points" not in arrays and len(arrays) != 1:
            raise InputError(f"{called} holds {sorted(arrays)}; name one of these `points`")
        points = arrays.get("points", next(iter(arrays.values())))
    elif ending == ".ply":
        loaded = by_trimesh(file, called, "points")
        if num := len(getattr(loaded, "faces", ())):
            raise InputError(
                f"{called} has {num} faces, which points leave open; give it as a mesh"
            )
        points = np.asarray(getattr(loaded, "vertices", ()))
    else:
        raise InputError(f"{called} is none of .npy, .npz, .pcd and .ply; convert it")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(f"{called} holds {points.dtype} {points.shape}; give numbers [K, 3]")
    return points[~np.isnan(points).any(axis=1)]


def _read_pcd(file: Path, called: str) -> np.ndarray:
    """x, y and z of a point cloud of PCL, in text or uncompressed."""
    content = file.read_bytes()
    header: dict[str, list[str]] = {}
    at = 0
    try:
        while "DATA" not in header:
            end = content.index(b"\n", at)
            name, *rest = content[at:end].decode("ascii").split() or ["#"]
            header[name] = rest
            at = end + 1
        fields, (count,), (form,) = header["FIELDS"], map(int, header["POINTS"]), header["DATA"]
        repeated = list(map(int, header.get("COUNT", ["1"] * len(fields))))
        where = [fields.index(axis) for axis in "xyz"]
        if form == "ascii":
            lines = content[at:].decode("ascii").split("\n")
            begin = np.cumsum([0, *repeated])
            rows = np.zeros((0, begin[-1]))
            if any(line.strip() for line in lines):
                rows = np.loadtxt(lines, ndmin=2)
            if len(rows) != count:
                raise ValueError(f"it promises {count} points, and there are {len(rows)}")
            return rows[:, begin[where]]
        if form == "binary":
            kinds = zip(fields, header["TYPE"], header["SIZE"], repeated, strict=True)
            record = np.dtype(
                [(f"{i}", f"<{_TYPES[t]}{s}", n) for i, (_, t, s, n) in enumerate(kinds)]
            )
            promised, given = count * record.itemsize, len(content) - at
            if promised != given:
                raise ValueError(f"it promises {promised} bytes of points, and there are {given}")
            rows = np.frombuffer(content, record, count, at)
            return np.stack([rows[f"{i}"].reshape(count) for i in where], axis=1).astype(float)
    except (ValueError, KeyError, UnicodeDecodeError) as error:
        raise InputError(f"{called} is no PCD file ({error}); save it anew") from None
    raise InputError(f"{called} is {form}; save it as ascii or binary")


def by_trimesh(file: Path, called: str, what: str) -> Any:
    """What trimesh reads from a file: a "mesh", with faces, or whatever there is.

    Raises:
        InputError: no such file, no trimesh, or nothing that it reads.
    """
    if not file.is_file():
        raise InputError(f"no {called}; check the path")
    try:
        import trimesh
    except ImportError:
        raise InputError(
            f"{called} is read by trimesh, which is missing; pip install trimesh"
        ) from None
    if ends_early(file):
        raise InputError(f"{called} ends too early; export it again")
    if counts_back(file):
        raise InputError(
            f"{called} has faces whose corners have numbers below 1, which are misread; number "
            "them from the first vertex on"
        )
    try:
        # As it is: by itself, trimesh leaves out what is not finite.
        form = {"force": "mesh"} if what == "mesh" else {}
        loaded = trimesh.load(str(file), process=False, **form)
    except Exception as error:  # whatever its readers of many formats raise
        raise InputError(f"{called} cannot be read ({error}); mend or convert it") from None
    if what == "mesh" and not (
        isinstance(loaded, trimesh.Trimesh) and len(loaded.faces) and len(loaded.vertices)
    ):
        raise InputError(f"{called} has no faces; points alone are a point_cloud")
    return loaded
