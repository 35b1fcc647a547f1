"""OctoMap's octrees, as balls around their occupied voxels.

A tree is written depth first, its root being a cube of 2^16 voxels a side about the origin; child i
of a node is on the upper side in x, y and z as far as the bits 1, 2 and 4 of i are set. In the
binary form (.bt) a node has two bits for each child: 01 free, 10 occupied, 11 to be read next. In
the full form (.ot) it has the logarithm of its odds of being occupied, and a bit for each child.
What is neither occupied nor free has not been seen, and is free here like what no point shows.
"""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gnnjax.errors import InputError, brief
from gnnjax.scene.cloud import BUCKETS, Balls
from gnnjax.scene.numbers import rotation_of, vector_of
from gnnjax.scene.scene import Scene, scene_from_shapes
from gnnjax.scene.shapes import IDENTITY_QUAT

_SIDE = 1 << 16  # voxels
_HEADERS = {b"# Octomap OcTree binary file": True, b"# Octomap OcTree file": False}
_MORE = {"OcTree": 0, "ColorOcTree": 3}  # bytes of a node beside its odds, in the full form


class _Node(NamedTuple):
    occupied: bool  # it is, as a leaf
    leaves: list[int]  # its children that are occupied leaves
    next: list[int]  # its children that are to be read
    end: int  # where it ends in the file


def octomap(
    file: str | Path,
    center: Sequence | np.ndarray = (0, 0, 0),
    quat: Sequence | np.ndarray = IDENTITY_QUAT,
) -> Balls:
    """The occupied voxels of a map, enclosed by a ball each: 0.87 of their edge in radius.

    Args:
        file: .bt or .ot, of an OcTree or ColorOcTree.
        center: where the map's origin is in the frame of the arm's base, m.
        quat: its orientation w x y z.

    Raises:
        InputError: no such file, no map in it, nothing occupied, or more voxels than a cloud can
            have.
    """
    called = f"octomap {str(file)!r}"
    try:
        content = Path(file).read_bytes()
    except FileNotFoundError:
        raise InputError(f"no {called}; check the path") from None
    except IsADirectoryError:
        raise InputError(f"{called} is a folder; name a file") from None
    except (OSError, ValueError) as error:  # a name that no file can have
        raise InputError(f"{called} cannot be read: {error}") from None
    head, _, data = content.partition(b"\ndata\n")
    binary = _HEADERS.get(head.partition(b"\n")[0].rstrip())
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    fields = {line[0]: line[1] for line in lines if len(line) == 2}
    if binary is None or not {"id", "res"} <= fields.keys():
        raise InputError(f"{called} does not begin as a .bt or .ot file does; save it anew")
    balls = voxels(data, binary, fields["id"], fields["res"], called)
    if not len(balls.points):
        raise InputError(f"{called} has no occupied voxel; check what was mapped")
    placed = balls.points @ rotation_of(quat, called).T + vector_of(center, f"center of {called}")
    return balls._replace(points=placed)


def voxels(data: bytes, binary: bool, kind: str, resolution: Any, called: str) -> Balls:
    """Balls around the occupied voxels of a tree, in its own frame; there may be none.

    Args:
        data: the tree, without a header.
        binary: its form.
        kind: `OcTree` or `ColorOcTree`; any that has a binary form.
        resolution: edge of a voxel, m.
        called: how error messages call it.
    """
    try:
        edge = float(resolution)
    except (TypeError, ValueError, OverflowError):
        edge = 0.0
    if not 0 < edge < np.inf:
        raise InputError(f"{called} has the resolution {brief(resolution)}; give an edge in m")
    if not (binary or kind in _MORE):
        raise InputError(f"{called} is of the kind {brief(kind)}; save it in the binary form, .bt")
    leaves = _leaves(data, _binary_node if binary else _full_node(4 + _MORE[kind]), called)
    corners, sizes = leaves[:, :3], leaves[:, 3]
    total = int((sizes**3).sum())
    if total > BUCKETS[-1]:
        raise InputError(
            f"{called} has {total} occupied voxels; at most {BUCKETS[-1]} are supported, cut it to "
            "what is around the arm, or make it coarser"
        )
    found = [np.zeros((0, 3))]
    for size in np.unique(sizes).tolist():
        inside = np.stack(np.meshgrid(*[np.arange(size)] * 3), axis=-1).reshape(-1, 3)
        found.append((corners[sizes == size, None] + inside).reshape(-1, 3))
    middles = np.concatenate(found) + 0.5 - _SIDE / 2
    return Balls(edge * middles, edge * np.sqrt(3) / 2)


def _leaves(data: bytes, read: Callable[[bytes, int], _Node], called: str) -> np.ndarray:
    """Lower corner and edge of the occupied leaves of a tree, `[N, 4]`, in voxels."""
    found: list[tuple[int, int, int, int]] = []
    at, stack = 0, [(0, 0, 0, _SIDE)] if data else []

    def child(i: int) -> tuple[int, int, int, int]:
        return x + half * (i & 1), y + half * (i >> 1 & 1), z + half * (i >> 2), half

    try:
        while stack:
            x, y, z, size = stack.pop()
            half, node = size // 2, read(data, at)
            if node.occupied:
                found.append((x, y, z, size))
            if (node.leaves or node.next) and not half:
                raise ValueError("it is deeper than 16 levels")
            found += map(child, node.leaves)
            stack += map(child, reversed(node.next))
            at = node.end
        if at != len(data):
            raise ValueError(f"{len(data) - at} bytes are left over")
    except struct.error:
        raise InputError(f"{called} ends in the middle of its tree; save it anew") from None
    except ValueError as error:
        raise InputError(f"{called} is no octree ({error}); save it anew") from None
    return np.array(found, np.int64).reshape(-1, 4)


def _binary_node(data: bytes, at: int) -> _Node:
    (bits,) = struct.unpack_from("<H", data, at)
    states = [bits >> 2 * i & 3 for i in range(8)]
    leaves, inner = ([i for i in range(8) if states[i] == wanted] for wanted in (2, 3))
    return _Node(False, leaves, inner, at + 2)


def _full_node(size: int) -> Callable[[bytes, int], _Node]:
    def read(data: bytes, at: int) -> _Node:
        (odds,) = struct.unpack_from("<f", data, at)
        (bits,) = struct.unpack_from("B", data, at + size)
        # Less than even odds are free, as OctoMap has it unless told.
        inner = [i for i in range(8) if bits >> i & 1]
        return _Node(not bits and not odds < 0, [], inner, at + size + 1)

    return read


def scene_from_octomap(file: str | Path, **placed: Any) -> Scene:
    """A scene of one map, whose further arguments are those of `octomap`."""
    return scene_from_shapes([], clouds=[octomap(file, **placed)], source=repr(str(file)))
