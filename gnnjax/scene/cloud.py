"""Clouds: obstacles of any form, as balls of one radius about many points.

What a depth camera sees, a mesh or a height field is brought into this one form, by balls that
enclose it. Kernels do not look at the balls, but at the squared distances of the nodes of a grid
to the nearest of their centres (`lookup.py`).
"""

import os
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gnnjax.errors import InputError, as_floats, as_typed, check_number

NODES = 48  # of the grid, along each axis
AROUND = 0.15  # m, of the grid beyond the points: where it ends, all spheres of an arm are clear
REACH = 3.0  # m; a cube of twice that about the base holds the grid. What leaves it is not free
BUCKETS = (256, 1024, 4096, 16384, 65536, 262144)  # padded numbers of points
VOXEL, RADIUS = 0.01, 0.01  # m, unless told
MOST_METERS = 1e4  # of any coordinate
_CURVE_BITS = 10  # a side of the curve that points are sorted along
_FAR = 1e3  # m; what a scene without a cloud is away from one


class Balls(NamedTuple):
    """All that is within a radius of some points."""

    points: np.ndarray  # [K 3] m
    radius: float  # m


class Cloud(NamedTuple):
    """The balls of a scene, padded, and the grid in which kernels look them up.

    Certificates see the points alone; kernels the grid, and the points where that tells too little.
    """

    points: Float[Array, "*batch K 3"]  # m, in the frame of the arm's base; neighbours together
    num: Int[Array, "*batch"]  # of them that exist; others are zeros
    radius: Float[Array, "*batch"]  # m
    lower: Float[Array, "*batch 3"]  # m, the first node
    cells: Float[Array, "*batch 3"]  # m, between neighbouring nodes
    squared: Float[Array, "*batch V"]  # m^2, from nodes to the nearest point; the last axis is z


def point_cloud(
    points: Sequence | np.ndarray,
    radius: float = RADIUS,
    voxel: float | None = VOXEL,
    *,
    source: str = "the cloud",
) -> Balls:
    """All within `radius` of points, enclosed by fewer balls: one for each voxel that has points.

    A ball stands in the middle of what is in its voxel. Its radius is greater than `radius` by as
    much as any voxel needs, no more than 0.87 of its edge; so that no ball stands out of those of
    the points by more than 1.74 edges, and on even surfaces by less than one.

    Args:
        points: `[K, 3]` m, in the frame of the arm's base.
        radius: m; half the distance of neighbouring points at least, or the arm fits in between.
        voxel: edge, m; None keeps each point.
        source: how error messages call the cloud.

    Raises:
        InputError: no points, another shape, a number that is not finite or beyond 10 km, a radius
            or voxel that is not positive.
    """
    array = checked_points(points, source)
    for name, size in (("radius", radius), ("voxel", voxel)):
        if name == "voxel" and voxel is None:
            continue
        check_number(size, f"{name} of {source}")
        if size is None or not 0 < size < np.inf:
            raise InputError(f"{name} of {source} is {as_typed(size)}; it must be positive (m)")
    if voxel is None:
        return Balls(array, float(radius))
    centers, more = _merged(array, voxel)
    return Balls(centers, float(radius + more))


def checked_points(points: Sequence | np.ndarray, source: str) -> np.ndarray:
    """Points as an array `[K, 3]`, or what is wrong with them; see `point_cloud`."""
    try:
        array = as_floats(points)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"points of {source} are not numbers; give [K, 3]") from None
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise InputError(
            f"points of {source} have shape {array.shape}; give [K, 3], one point or more"
        )
    bad = ~(np.abs(array) <= MOST_METERS).all(axis=1)
    if bad.any():
        i = int(bad.argmax())
        raise InputError(
            f"point {i} of {source} is {as_typed(array[i])}, one of {int(bad.sum())} that are not "
            f"finite or beyond {MOST_METERS:g} m; remove these"
        )
    return array


def _merged(points: np.ndarray, voxel: float) -> tuple[np.ndarray, float]:
    """The middle of the points of each voxel, and how far one of them is from it at most, m."""
    key = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    size = key.max(axis=0) + 1
    if float(np.prod(size.astype(float))) > 2.0**62:
        raise InputError(f"a voxel of {voxel:g} m is too small for points so far apart; enlarge it")
    flat = (key[:, 0] * size[1] + key[:, 1]) * size[2] + key[:, 2]
    order = np.argsort(flat, kind="stable")
    first = np.flatnonzero(np.diff(flat[order], prepend=-1))
    low = np.minimum.reduceat(points[order], first)
    high = np.maximum.reduceat(points[order], first)
    return (low + high) / 2, float(np.sqrt(((high - low) ** 2).sum(axis=1).max())) / 2


def make_cloud(clouds: Sequence[Balls], source: str = "the scene") -> Cloud:
    """Clouds as one, for a scene: all balls get the greatest of the radii.

    Raises:
        InputError: more points than the largest bucket holds.
    """
    points = np.concatenate([balls.points for balls in clouds]).astype(np.float32)
    points = points[np.argsort(_places_on_curve(points), kind="stable")]
    radius = max(balls.radius for balls in clouds)
    room = next((bucket for bucket in BUCKETS if len(points) <= bucket), None)
    if room is None:
        raise InputError(
            f"{source} has clouds of {len(points)} points; at most {BUCKETS[-1]} are supported, "
            "choose larger voxels"
        )
    nearest = float(np.sqrt((points**2).sum(axis=1).min()))
    if nearest > REACH:
        warnings.warn(
            f"all points of the clouds of {source} are {nearest:g} m or more from the arm's base, "
            "out of its reach; are they in millimetres, or in the camera's frame?",
            stacklevel=3,
        )
    lower, cells, squared = _grid(points)
    padded = np.pad(points, ((0, room - len(points)), (0, 0)))
    return Cloud(
        padded, np.int32(len(points)), np.float32(radius), lower, cells, squared.astype(np.float32)
    )


def _grid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First node, cells and squared distances of a grid over what is in reach of points `[K, 3]`.

    Outside of it, kernels measure from the nearest point of its box. They may, as beyond that side
    there are no points, or it is out of reach.
    """
    lower = np.clip(points.min(axis=0) - np.float32(AROUND), -REACH, REACH)
    upper = np.clip(points.max(axis=0) + np.float32(AROUND), -REACH, REACH)
    cells = np.maximum((upper - lower) / (NODES - 1), np.float32(1e-4))
    sides = lower.astype(float)[:, None] + cells.astype(float)[:, None] * np.arange(NODES)
    nodes = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    from scipy.spatial import cKDTree  # a fifth of a second, for clouds alone

    # A third of the time of a balanced tree, for points that are spread evenly.
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    away, _ = tree.query(nodes, workers=os.cpu_count() or 1)
    return lower, cells, away * away


def _places_on_curve(points: Any) -> Any:
    """Where points `[K, 3]` in reach lie on a Z-shaped curve (Morton, 1966), along which neighbours
    are mostly near each other; of NumPy, or inside of compiled functions."""
    share = ((points + REACH) * (1 / (2 * REACH))).clip(0.0, 1.0)
    cells = (share * (2.0**_CURVE_BITS - 1.0)).astype(np.int32)
    place = 0
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            place = place | ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return place


def cloud_of(points: Float[Array, "K 3"], radius: float) -> Cloud:
    """`make_cloud` inside of compiled functions, of points of which some are NaN, and none.

    Args:
        points: m, in reach.
        radius: of the balls, m.
    """
    exists = jnp.isfinite(points).all(axis=1)
    points = jnp.where(exists[:, None], points, 0.0)
    order = jnp.argsort(jnp.where(exists, _places_on_curve(points), 8**_CURVE_BITS))
    points, exists = points[order], exists[order, None]
    lower = jnp.min(points, axis=0, where=exists, initial=REACH) - AROUND
    upper = jnp.max(points, axis=0, where=exists, initial=-REACH) + AROUND
    lower, upper = (jnp.clip(x, -REACH, REACH) for x in (lower, upper))
    cells = jnp.maximum((upper - lower) / (NODES - 1), 1e-4)
    away = lower + cells * jnp.arange(NODES)[:, None] - points[:, None]  # [K NODES 3]
    # What does not exist is far away.
    x, y, z = jnp.moveaxis(jnp.where(exists[..., None], away * away, _FAR * _FAR), -1, 0)

    def slab(x: jax.Array) -> jax.Array:
        return jnp.min((x[:, None] + y)[:, :, None] + z[:, None], axis=0)

    squared = jax.lax.map(slab, x.T).reshape(-1)
    num = exists.sum().astype(jnp.int32)
    return Cloud(points, num, jnp.float32(radius), lower, cells, squared)


def no_cloud(room: int = 0) -> Cloud:
    """What a scene without a cloud has in a batch in which others have one.

    Args:
        room: padded number of points.
    """
    return Cloud(
        np.zeros((room, 3), np.float32),
        np.int32(0),
        np.float32(0),
        np.zeros(3, np.float32),
        np.ones(3, np.float32),
        np.full(NODES**3, _FAR * _FAR, np.float32),
    )


def with_room(cloud: Cloud, room: int) -> Cloud:
    """A NumPy cloud, or batch of clouds, with room for so many points."""
    points = np.asarray(cloud.points)
    widths = [(0, 0)] * points.ndim
    widths[-2] = (0, room - points.shape[-2])
    return cloud._replace(points=np.pad(points, widths))
