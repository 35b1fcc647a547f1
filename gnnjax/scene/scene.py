"""Scenes: obstacles in the frame of the arm's base, padded to a fixed number with a mask."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, UInt32

from gnnjax.errors import InputError, brief, is_list
from gnnjax.scene.cloud import Balls, Cloud, make_cloud
from gnnjax.scene.numbers import check_shapes, sums_from
from gnnjax.scene.shapes import (
    FIELDS,
    IDENTITY_QUAT,
    KINDS,
    Sums,
    kind_of,
)

# Padded numbers of obstacles; one compilation each. The first holds the paper's 2 to 9 boxes.
OBSTACLE_BUCKETS = (10, 16, 32, 64, 128)

_BLANK_SIZE = 0.1  # m; padding has a size, so that nothing divides by zero


class Allowed(NamedTuple):
    """Allowed contacts; made by `allow_contacts`."""

    pairs: Bool[Array, "*batch M L"]  # true where body l of the arm may touch obstacle m
    arm: UInt32[Array, "*batch"]  # of which arm, see `arm_key`


class Scene(NamedTuple):
    """Obstacles in the frame of the arm's base, wherever its MJCF puts that.

    Each is the sum (Minkowski's) of a box, a disc about the box's z axis, and a ball, one or two of
    which are zero: see `shapes.py`. Scenes are made by `make_scene` and `scene_from_shapes`. What
    has another form is in its cloud (`cloud.py`).
    """

    centers: Float[Array, "*batch M 3"]  # m
    half_extents: Float[Array, "*batch M 3"]  # m, of the box
    quats: Float[Array, "*batch M 4"]  # unit quaternions w x y z, obstacle to base
    radii: Float[Array, "*batch M 2"]  # m, of the disc and of the ball
    mask: Bool[Array, "*batch M"]  # true where the obstacle exists
    cloud: Cloud | None = None
    allowed: Allowed | None = None


def box_scene(
    centers: ArrayLike, half_extents: ArrayLike, quats: ArrayLike, mask: ArrayLike
) -> Scene:
    """A scene of boxes alone, of arrays `[*batch, M, ...]` as they are."""
    zeros = np.zeros if isinstance(mask, np.ndarray) else jnp.zeros
    radii = zeros((*np.shape(mask), 2), np.float32)
    return Scene._make([centers, half_extents, quats, radii, mask, None, None])


def obstacle_bucket(num: int, source: str = "the scene") -> int:
    """The padded number of obstacles for a scene of `num`."""
    for bucket in OBSTACLE_BUCKETS:
        if num <= bucket:
            return bucket
    raise InputError(
        f"{source} has {num} obstacles; at most {OBSTACLE_BUCKETS[-1]} are supported, merge some"
    )


def check_is_scene(scene: object) -> None:
    """Refuses what is no scene, nor several in one.

    Raises:
        InputError: names what it is.
    """
    if not isinstance(scene, Scene):
        raise InputError(
            f"the scene is a {type(scene).__name__}; make one with make_scene, scene_from_shapes "
            "or scene_from_json"
        )


def check_single(scene: object) -> None:
    """Refuses what is no scene, and several in one.

    Raises:
        InputError: names what it is.
    """
    check_is_scene(scene)
    assert isinstance(scene, Scene)
    if np.ndim(scene.mask) != 1:
        raise InputError(f"the scene is {len(scene.mask)} in one; give one after the other")


def scene_from_shapes(
    shapes: Sequence,
    *,
    clouds: Sequence = (),
    max_obstacles: int | None = None,
    source: str = "the scene",
) -> Scene:
    """Builds a scene of any obstacles: `scene_from_shapes([box(...), cylinder(...)])`.

    Args:
        shapes: what stands there; boxes come first in the scene, then each other kind.
        clouds: what stands there in other forms, made by `point_cloud`, `mesh` and `height_field`;
            the balls of all get the greatest of their radii.
        max_obstacles: padded number; by default the smallest bucket that fits.
        source: how error messages call the scene, a file name for example.

    Raises:
        InputError: what is no shape or no cloud; a number that is missing, not finite or beyond 10
            km, a size that is not positive, a quaternion or normal of zeros.
    """
    check_shapes(shapes, "shapes")
    if isinstance(clouds, Balls) or not (
        is_list(clouds) and all(isinstance(balls, Balls) for balls in clouds)
    ):
        raise InputError(
            f"clouds of {source} is {brief(clouds)}; give a list of point_cloud(...), mesh(...), "
            "..."
        )
    parts = []
    for kind in KINDS:
        chosen = [shape.values for shape in shapes if shape.kind == kind]
        if chosen:
            columns = {name: [values[name] for values in chosen] for name in FIELDS[kind]}
            parts.append(sums_from(kind, columns, source))
    joined = [np.concatenate(x) for x in zip(*parts, strict=True)] if parts else _NOTHING
    num = len(joined[0])
    cloud = make_cloud(clouds, source) if clouds else None
    scene = Scene._make([*(x.astype(np.float32) for x in joined), np.ones(num, bool), cloud, None])
    return pad_scene(
        scene, obstacle_bucket(num, source) if max_obstacles is None else max_obstacles
    )


_NOTHING = Sums(*(np.zeros((0, width)) for width in (3, 3, 4, 2)))


def make_scene(
    centers: Sequence | np.ndarray,
    half_extents: Sequence | np.ndarray,
    quats: Sequence | np.ndarray | None = None,
    *,
    max_obstacles: int | None = None,
    source: str = "the scene",
) -> Scene:
    """Builds a scene of boxes from `[M, 3]`, `[M, 3]` and `[M, 4]` (or no quaternions).

    Args:
        centers: box centres, m.
        half_extents: half the edge lengths, m.
        quats: orientations w x y z; normalized here.
        max_obstacles: padded size; by default the smallest bucket that fits.
        source: how error messages call the scene, a file name for example.

    Raises:
        InputError: wrong shape, a number that is not finite or beyond 10 km, a size that is not
            positive, a quaternion of zeros.
    """
    given = {"center": centers, "half_extents": half_extents}
    if quats is not None:
        given["quat"] = quats
    sums = sums_from("box", given, source)
    num = len(sums.centers)
    scene = Scene._make([*(x.astype(np.float32) for x in sums), np.ones(num, bool), None, None])
    return pad_scene(
        scene, obstacle_bucket(num, source) if max_obstacles is None else max_obstacles
    )


def pad_scene(scene: Scene, max_obstacles: int) -> Scene:
    """Pads a scene `[*batch, M]` with obstacles that do not exist, up to `max_obstacles`; of
    NumPy's arrays, or inside of compiled functions."""
    missing = max_obstacles - scene.mask.shape[-1]
    if missing < 0:
        raise InputError(
            f"the scene has room for {scene.mask.shape[-1]} obstacles, more than {max_obstacles}; "
            "raise max_obstacles"
        )
    arrays = np if isinstance(scene.mask, np.ndarray) else jnp

    def pad(array: Any, value: float | bool) -> Any:
        widths = [(0, 0)] * array.ndim
        widths[scene.mask.ndim - 1] = 0, missing
        return arrays.pad(array, widths, constant_values=value)

    quats = arrays.asarray(scene.quats)
    identity = arrays.asarray(IDENTITY_QUAT, quats.dtype)
    blank = arrays.broadcast_to(identity, (*quats.shape[:-2], missing, 4))
    return Scene(
        pad(scene.centers, 0.0),
        pad(scene.half_extents, _BLANK_SIZE),
        arrays.concatenate([quats, blank], axis=-2),
        pad(scene.radii, 0.0),
        pad(scene.mask, False),
        scene.cloud,
        scene.allowed and scene.allowed._replace(pairs=pad(scene.allowed.pairs, False)),
    )


def without_meant(scene: Scene) -> Scene:
    """A scene, or scenes, for guides, which know of no bodies: less what some body may touch."""
    if scene.allowed is None:
        return scene
    met = scene.allowed.pairs.any(axis=-1)
    return scene._replace(mask=scene.mask & ~met, allowed=None)


def without_points(scene: Scene) -> Scene:
    """A scene for kernels, which look a cloud up in its grid; certificates refuse it."""
    if scene.cloud is None:
        return scene
    return scene._replace(cloud=scene.cloud._replace(points=scene.cloud.points[..., :0, :]))


def is_axis_aligned(scene: Scene) -> bool:
    """Whether no existing box of the scene, or batch of scenes, is rotated (host side)."""
    quats = np.asarray(scene.quats)[np.asarray(scene.mask)]
    # Not by w, which float32 rounds to 1 for rotations of nearly 1 mrad.
    return bool((np.abs(quats[:, 1:]) < 1e-7).all())


def last_obstacle(mask: Bool[Array, "*batch M"]) -> Int[Array, ""]:
    """How many boxes have to be looked at: none after the last that exists in any scene."""
    return jnp.max(jnp.where(mask, jnp.arange(1, mask.shape[-1] + 1), 0), initial=0)


def rotation_matrices(quats: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrices of unit quaternions w x y z."""
    w, x, y, z = jnp.moveaxis(quats, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def inflated(scene: Scene, margin: float) -> Scene:
    """Obstacles as large as all that is within `margin` [m] of them; padding stays."""
    if margin == 0:
        return scene
    more = np.where(np.asarray(scene.mask)[..., None], np.float32([0, margin]), np.float32(0))
    cloud = scene.cloud
    if cloud is not None:
        cloud = cloud._replace(radius=np.asarray(cloud.radius) + np.float32(margin))
    return scene._replace(radii=scene.radii + more, cloud=cloud)


def obstacle_name(scene: Scene, i: int) -> str:
    """How error messages call obstacle i of one scene: its kind, and its number among those. The
    one after the last is its cloud."""
    if i == len(scene.mask) and scene.cloud is not None:
        return "the cloud"
    kinds = kind_of(scene.half_extents, scene.radii)
    number = int((np.asarray(scene.mask)[:i] & (kinds[:i] == kinds[i])).sum())
    return f"{KINDS[kinds[i]] if kinds[i] >= 0 else 'obstacle'} {number}"
