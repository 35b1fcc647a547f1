"""What the certificate knows of obstacles: whether they are any, and how far points are from them.

In NumPy and double precision, apart from the planning kernels, and checked by itself, whatever was
checked before. Arrays have their components first and what they are computed for last: every sum is
then of whole rows, and what is found for one point does not depend on its neighbours.
"""

import functools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gnnjax.errors import InputError, as_typed, brief
from gnnjax.scene.scene import Scene

_MOST_METERS = 1e4  # of an obstacle; what lies beyond is no scene of an arm
_QUAT_ERROR = 1e-4  # how far from 1 a quaternion's length may be


class Obstacles:
    """The existing obstacles of P scenes, or of one, in double precision."""

    is_batch: bool  # whether they are of P scenes
    exists: np.ndarray  # [M P]
    centers: np.ndarray  # [3 M P] m; any obstacle lies in the ball of its radius about its center
    radii: np.ndarray  # [M P] m
    has_clouds: bool
    cloud_radii: np.ndarray  # [P] m, of their balls; where there are clouds
    allowed: np.ndarray | None  # [L+1 M P] contacts that are meant, by body; the world comes last
    arm: np.ndarray | None  # the `arm_key` of the arm that these are of, in each scene

    def __init__(self, scenes: Scene):
        mask, centers, half_extents, quats, radii = _arrays(scenes)
        self.is_batch = np.ndim(scenes.mask) == 2
        self.exists = mask.T
        # What does not exist may hold anything.
        self.centers, sizes, quats, radii = (
            np.where(self.exists, x.T, 1.0) for x in (centers, half_extents, quats, radii)
        )
        disc, ball = radii
        beside = np.sqrt(sizes[0] * sizes[0] + sizes[1] * sizes[1]) + disc
        self.radii = np.sqrt(beside * beside + sizes[2] * sizes[2]) + ball
        w, x, y, z = quats / np.sqrt(sum_of_squares(quats))
        axes = [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
        rows = [*self.centers, *sizes, *axes[0], *axes[1], *axes[2], disc, ball]
        self._table = np.stack(rows).reshape(17, -1)
        self.allowed = self.arm = None
        if scenes.allowed is not None:
            pairs, self.arm = (np.asarray(x) for x in scenes.allowed)
            pairs = pairs if pairs.ndim == 3 else pairs[None]
            self.allowed = np.concatenate([pairs.T, np.zeros((1, *self.exists.shape), bool)])
        self.has_clouds = scenes.cloud is not None
        if self.has_clouds:
            points, num, self.cloud_radii = _clouds(scenes)
            self._clouds = [own[:count].tobytes() for own, count in zip(points, num, strict=True)]
            self._dtype = points.dtype.str

    def cloud_distances(self, points: np.ndarray, scene: np.ndarray) -> np.ndarray:
        """Distances [m] of points `[3, N]`, each to the balls of its scene's cloud, `[N]`; infinite
        where it has none. Found among the points themselves, whatever the kernels' grids say."""
        found = np.full(len(scene), np.inf)
        for number in np.unique(scene).tolist():
            if self._clouds[number]:
                rows = np.flatnonzero(scene == number)
                away, _ = self._tree(number).query(points[:, rows].T)
                found[rows] = away - self.cloud_radii[number]
        return found

    def cloud_points(
        self, places: np.ndarray, reach: np.ndarray, scene: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """All points of clouds that are within `reach` `[N]` m of places `[3, N]`, each of its
        scene's: of which place each is, `[K]`, and they themselves, `[3, K]`."""
        rows, found = [np.zeros(0, int)], [np.zeros((0, 3))]
        for number in np.unique(scene).tolist():
            if self._clouds[number]:
                own, tree = np.flatnonzero(scene == number), self._tree(number)
                near = tree.query_ball_point(places[:, own].T, reach[own])
                rows.append(np.repeat(own, [len(x) for x in near]))
                found.append(tree.data[np.concatenate(near).astype(int)])
        return np.concatenate(rows), np.concatenate(found).T

    def _tree(self, number: int) -> Any:
        return _tree(self._clouds[number], self._dtype)

    def distances(self, points: np.ndarray, number: np.ndarray, scene: np.ndarray) -> np.ndarray:
        """Distances [m] of points `[3, N]`, each to one obstacle of its scene, `[N]`.

        Inside of an obstacle 0, or minus the depth in its ball.
        """
        table = self._table.take(number * self.exists.shape[1] + scene, axis=1)
        along = dot(table[6:15].reshape(3, 3, -1).swapaxes(0, 1), points - table[:3])
        outside = np.maximum(np.abs(along) - table[3:6], 0)
        disc, ball = table[15:]
        beside = np.maximum(np.sqrt(sum_of_squares(outside[:2])) - disc, 0)
        return np.sqrt(beside * beside + outside[2] * outside[2]) - ball

    def sums(
        self, number: np.ndarray, scene: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Centers `[3, N]`, axes `[3, 3, N]` (the first is x), half extents `[3, N]`, and radii
        `[N]` of discs and balls."""
        table = self._table.take(number * self.exists.shape[1] + scene, axis=1)
        return table[:3], table[6:15].reshape(3, 3, -1), table[3:6], table[15], table[16]


@functools.lru_cache(maxsize=64)
def _tree(points: bytes, dtype: str) -> Any:
    """A tree of points `[K, 3]`, which a path's certificates share with those to come."""
    from scipy.spatial import cKDTree  # a fifth of a second, for clouds alone

    own = np.frombuffer(points, dtype).reshape(-1, 3)
    return cKDTree(own, balanced_tree=False, compact_nodes=False)


def obstacles_of(scenes: Scene) -> Obstacles:
    """The existing obstacles of one scene or of P scenes, or what is wrong with them.

    Those of a batch of one scene are kept: a query's check and its certificates ask for the same.
    """
    plain = scenes.cloud is None and scenes.allowed is None
    if plain and np.ndim(scenes.mask) == 2 and len(scenes.mask) == 1:
        arrays = [np.asarray(x) for x in scenes[:5]]
        if all(x.dtype.kind in "bif" for x in arrays):
            return _of_one(*((x.tobytes(), x.dtype.str, x.shape) for x in arrays))
    return _checked(scenes)


@functools.lru_cache(maxsize=16)
def _of_one(*arrays: tuple[bytes, str, tuple[int, ...]]) -> Obstacles:
    """`obstacles_of` a scene by what its arrays hold, which nobody can write to any more."""
    own = (np.frombuffer(held, dtype).reshape(shape) for held, dtype, shape in arrays)
    return _checked(Scene._make([*own, None, None]))


def _checked(scenes: Scene) -> Obstacles:
    for number, fault in enumerate(scene_faults(scenes)):
        if fault is not None:
            single = np.ndim(scenes.mask) == 1
            raise InputError(fault if single else f"scene {number}: {fault}")
    return Obstacles(scenes)


def scene_faults(scenes: Scene) -> list[str | None]:
    """What is wrong with each of P scenes, or with one: None where something can be proven in it.

    Raises:
        InputError: arrays of other shapes, which are no scenes at all.
    """
    mask, centers, half_extents, quats, radii = _arrays(scenes)
    with np.errstate(over="ignore", invalid="ignore"):
        norms = np.sqrt(np.add.reduce(quats * quats, axis=2, keepdims=True))
    # Written so that NaN fails. A sum may be of no kind of ours: a box with a margin around it.
    sizes = np.concatenate([half_extents, radii], axis=2)
    x, y, z, disc, ball = (sizes > 0).transpose(2, 0, 1)
    solid = (ball | (z & (disc | (x & y))))[..., None] & (sizes >= 0)
    rules = (
        ("centers", centers, "finite", np.abs(centers) <= _MOST_METERS),
        (
            "half_extents and radii",
            sizes,
            "positive, as far as its kind has them",
            solid & (sizes <= _MOST_METERS),
        ),
        ("quats", quats, "of length 1", np.abs(norms - 1) <= _QUAT_ERROR),
    )
    faults: list[str | None] = [None] * len(mask)
    for name, values, rule, good in rules:
        bad = mask & ~np.logical_and.reduce(good, axis=2)
        if not bad.any():
            continue
        for i in np.flatnonzero(bad.any(axis=1)):
            which = bad[i].argmax()
            faults[i] = faults[i] or (
                f"existing obstacle {mask[i, :which].sum()} of the scene has {name} "
                f"{as_typed(values[i, which])}, which must be {rule} (m, below {_MOST_METERS:g}); "
                "make scenes with make_scene or scene_from_shapes"
            )
    if scenes.cloud is not None:
        for i, fault in enumerate(_cloud_faults(*_clouds(scenes))):
            faults[i] = faults[i] or fault
    return faults


def _clouds(scenes: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points `[P, K, 3]`, their numbers and radii `[P]`; P = 1 for one scene."""
    assert scenes.cloud is not None
    batch = np.shape(scenes.mask)[:-1]
    points = np.asarray(scenes.cloud.points)
    num, radius = np.asarray(scenes.cloud.num), np.asarray(scenes.cloud.radius, float)
    good = points.shape[:-2] == num.shape == radius.shape == batch and points.shape[-1:] == (3,)
    if not good or num.dtype.kind not in "iu":
        raise InputError(
            f"points, number and radius of the scene's cloud have shapes {points.shape}, "
            f"{num.shape} and {radius.shape}, and the mask {np.shape(scenes.mask)}; make scenes "
            "with scene_from_shapes"
        )
    return (points, num, radius) if batch else (points[None], num[None], radius[None])


def _cloud_faults(points: np.ndarray, num: np.ndarray, radius: np.ndarray) -> list[str | None]:
    """What is wrong with each of P clouds."""
    faults: list[str | None] = []
    for own, count, size in zip(points, num, radius, strict=True):
        fault = None
        if not 0 <= count <= len(own):
            fault = f"has {count} points, of which {len(own)} are there"
        elif not (np.abs(own[:count]) <= _MOST_METERS).all():
            fault = f"has points that are not finite, or beyond {_MOST_METERS:g} m"
        elif count and not 0 < size <= _MOST_METERS:
            fault = f"has the radius {size:g} m, which must be positive"
        faults.append(fault and f"the cloud of the scene {fault}; use scene_from_points")
    return faults


def _arrays(scenes: Scene) -> list[np.ndarray]:
    """Mask `[P, M]`, centers, half extents, quats and radii `[P, M, ...]`; P = 1 for one scene."""
    mask = np.asarray(scenes.mask)
    # Numbers instead of a mask would choose rows.
    if mask.dtype != bool or mask.ndim not in (1, 2):
        raise InputError(f"the mask of the scene is {mask.dtype} {mask.shape}; give bool [M]")
    arrays = [mask]
    for name, values, width in zip(Scene._fields[:4], scenes[:4], (3, 3, 4, 2), strict=True):
        array = np.asarray(values, float)
        if array.shape != (*mask.shape, width):
            wanted = ", ".join(map(str, (*mask.shape, width)))
            raise InputError(f"{name} of the scene have shape {array.shape}; give [{wanted}]")
        arrays.append(array)
    return arrays if mask.ndim == 2 else [x[None] for x in arrays]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of vectors of three components, which come first."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of vectors of three components, which come first."""
    return np.stack([a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)])


def sum_of_squares(parts: np.ndarray | list[np.ndarray]) -> np.ndarray:
    """Of the components of vectors, which come first."""
    total = parts[0] * parts[0]
    for part in parts[1:]:
        total = total + part * part
    return total


def owners_of(obstacles: Obstacles, owner: ArrayLike | None, num: int) -> np.ndarray:
    """The scene of each of `num` edges, or what is wrong with them."""
    if not obstacles.is_batch and owner is None:
        return np.zeros(num, int)
    array = np.asarray(owner)
    num_scenes = obstacles.exists.shape[1] if obstacles.is_batch else 0
    good = array.shape == (num,) and array.dtype.kind in "iu"
    if not good or not ((array >= 0) & (array < num_scenes)).all():
        raise InputError(
            f"owner is {brief(owner)} for {num} edges and {num_scenes} scenes in a batch; give the "
            "number of its scene an edge, and none where there is one scene"
        )
    return array.astype(int)
