"""The cells of a contact map, worked out: at which joint values two parts touch.

What is proven of a cell is proven at its middle. From there to anywhere in the cell, the distance
of the parts changes by no more than the joints move, times how far from each joint's axis the one
of the two parts lies that comes less far from it. So parts that are farther apart than that are
clear in all of the cell; and they touch in all of it, if what of one of them is farther inside than
that meets the other. Cells of which neither is so are halved, along the joint that moves the parts
most.
"""

import contextlib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.collision import convex
from gnnjax.collision.couples import Couple, Side, frames_of, ranges, reaches, unproven_by_spheres
from gnnjax.kept import keep

CLEAR, OPEN, TOUCHING = range(3)  # what a cell says
A_WORD = 16  # cells
_A_LINE = 256  # cells, of 64 bytes
_BITS = {1: 12, 2: 18, 3: 20}  # of the number of cells, by the number of joints
# Of the configurations, by the number of joints: whose spheres leave more open is worth a map.
_WORTH = {1: 1e-3, 2: 1e-3, 3: 5e-3}
_MANY = 16  # pairs of spheres, which take longer than to look a map of up to two joints up
_SAMPLES = 4096
_AT_ONCE = 1024  # cells
_ROUNDED = 5e-5  # m; by more than that, single precision moves no part
_NOT_APART = 2e-4  # m; parts that overlap by more are never taken for separate ones
_NOWHERE = 1e3  # m
_ROOM = 64  # vertices; hulls are padded to a multiple


class Cells(NamedTuple):
    """Of a couple, what its cells say: `counts` along each joint, each a power of two.

    Cells lie in blocks of `block` along each joint, since motions go from cells to their neighbours
    and what they find there is in the same line of a cache.
    """

    counts: np.ndarray  # [K]
    block: np.ndarray  # [K]
    words: np.ndarray  # uint32, of 16 cells each, the lowest bits first
    beside: bool  # spheres are worth a look, too


def cells_of(couple: Couple) -> Cells | None:
    """Works the map of a couple out; None where its spheres do without.

    Args:
        couple: two parts.
    """
    lower, upper, _ = ranges(couple)
    num = len(lower)
    # The same for every arm and every time.
    drawn = np.random.default_rng(0).uniform(lower, upper, (_SAMPLES, num))
    unproven = unproven_by_spheres(couple, drawn)
    few = num > 2 or len(couple.pairs) < _MANY
    if few and unproven.mean() < _WORTH[num]:
        return None
    codes = _refined(couple, lower, upper)
    counts = np.array(codes.shape)
    at = np.floor((drawn - lower) * (counts / (upper - lower))).astype(int)
    is_open = codes[tuple(np.minimum(at, counts - 1).T)] == OPEN
    # Where both together leave much less open than the map, spheres are looked at first.
    beside = bool(is_open.mean() > 2 * (is_open & unproven).mean() + 2e-3)
    block = _block(counts)
    parts = np.stack([counts // block, block], axis=1).reshape(-1)
    order = *range(0, 2 * num, 2), *range(1, 2 * num, 2)
    codes = codes.reshape(parts).transpose(order).reshape(-1)
    padded = np.pad(codes, (0, -codes.size % A_WORD)).reshape(-1, A_WORD)
    words = (padded.astype(np.uint32) << np.arange(0, 32, 2, dtype=np.uint32)).sum(axis=1)
    return Cells(counts, block, words.astype(np.uint32), beside)


def _block(counts: np.ndarray) -> np.ndarray:
    """Of as many cells as a line of a cache holds, about as many along each joint."""
    block = np.ones_like(counts)
    while block.prod() < _A_LINE and (block < counts).any():
        block[np.where(block < counts, block, _A_LINE).argmin()] *= 2
    return block


def _refined(couple: Couple, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """What each cell says, `[counts]`."""
    reach, num = reaches(couple), len(lower)
    codes = np.full((1,) * num, OPEN, np.uint8)
    while True:
        width = (upper - lower) / codes.shape
        most = float(reach @ width) / 2 + _ROUNDED
        cells = np.stack(np.nonzero(codes == OPEN), axis=1)
        codes[tuple(cells.T)] = _codes_at(couple, lower + (cells + 0.5) * width, most)
        if codes.size >= 2 ** _BITS[num] or not (codes == OPEN).any():
            return codes
        codes = np.repeat(codes, 2, axis=int(np.argmax(reach * width)))


def _codes_at(couple: Couple, q: np.ndarray, most: float) -> np.ndarray:
    """What is proven where the distance of the parts changes by `most` from what it is at joint
    values `[N K]`."""
    first, second = couple.sides
    smaller = first._replace(**_smaller(first, most + _NOT_APART))
    codes = np.where(_apart(couple, q, most), CLEAR, OPEN)
    (left,) = np.nonzero(codes == OPEN)
    meeting = ~_apart(couple._replace(sides=(smaller, second)), q[left], 0.0)
    codes[left[meeting]] = TOUCHING
    return codes


def _apart(couple: Couple, q: np.ndarray, margin: float) -> np.ndarray:
    """Whether the parts are farther apart than a margin, m, at joint values `[N K]`."""
    hulls = [side.vertices for side in couple.sides]
    room = -(-max(map(len, hulls)) // _ROOM) * _ROOM
    padded = np.stack([np.pad(v, ((0, room - len(v)), (0, 0)), "edge") for v in hulls])
    radii = np.array([side.radius for side in couple.sides])
    parts = convex.Parts(padded.astype(np.float32), radii.astype(np.float32))
    found = [np.empty(0, bool)]
    for begin in range(0, len(q), _AT_ONCE):
        rows = q[begin : begin + _AT_ONCE]
        full = np.pad(rows, ((0, _AT_ONCE - len(rows)), (0, 0)), "edge")
        here, there = (frames_of(couple, side, full)[-1] for side in couple.sides)
        turned = np.swapaxes(there[..., :3], 1, 2)
        position = np.einsum("nab,nb->an", turned, here[..., 3] - there[..., 3])
        rotation = np.einsum("nab,nbc->acn", turned, here[..., :3])
        seen = position.astype(np.float32), rotation.astype(np.float32)
        found.append(np.asarray(_TEST(parts, *seen, np.float32(margin)))[: len(rows)])
    return np.concatenate(found)


def _smaller(side: Side, by: float) -> dict[str, Any]:
    """The hull and the ball of what of a part is at least `by` away from its surface, without some
    of its corners; far away where there is none."""
    from scipy.spatial import HalfspaceIntersection, QhullError

    if side.radius >= by:
        return {"radius": side.radius - by}
    faces, outwards, middle, depth = _faces(side)
    by -= side.radius
    if depth > by + _ROUNDED:
        faces = faces + np.array([0.0, 0.0, 0.0, by])
        with contextlib.suppress(QhullError):
            corners = HalfspaceIntersection(faces, middle).intersections
            chosen = np.unique((corners @ outwards.T).argmax(axis=0))
            return {"vertices": corners[chosen], "radius": 0.0}
    return {"vertices": np.full((1, 3), _NOWHERE), "radius": 0.0}


def _faces(side: Side) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Planes `[F 4]` of a part's hull, none of a flat one, directions outwards at its corners, the
    point that lies deepest in it, and how deep, m."""
    # A third of a second each, for those who map an arm.
    from scipy.optimize import linprog
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(side.vertices)
    except (QhullError, ValueError):  # flat, or too few
        return np.empty((0, 4)), np.eye(3), side.vertices.mean(axis=0), 0.0
    faces = hull.equations
    outwards = np.zeros_like(side.vertices)
    np.add.at(outwards, hull.simplices, faces[:, None, :3])
    system = np.column_stack([faces[:, :3], np.ones(len(faces))])
    free = [(None, None)] * 4
    *middle, depth = linprog([0, 0, 0, -1], system, -faces[:, 3], bounds=free).x
    return faces, outwards[hull.vertices], np.array(middle), float(depth)


def _test(
    parts: convex.Parts,
    position: Float[Array, "3 N"],
    rotation: Float[Array, "3 3 N"],
    margin: Float[Array, ""],
) -> Bool[Array, " N"]:
    """Whether the first of two parts is farther than a margin from the other, where that is seen
    from."""
    num = position.shape[1]
    first, other = (jnp.full(num, which, jnp.int32) for which in range(2))
    margins = jnp.broadcast_to(margin, (num,))
    found = convex.separate_parts(parts, first, position, rotation, other, position, margins)
    return found.gaps > 0


_TEST = keep(_test)
