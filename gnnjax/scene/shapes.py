"""Kinds of obstacles: how people describe them, and the one form in which they are computed with.

Every obstacle is the sum (Minkowski's) of a box, a disc about the box's z axis, and a ball. With
what is zero left out that is a box, sphere, capsule or cylinder, and a half-space is a box so large
that no arm sees its other faces. So kernels, certificate and distance field know one form, and what
is new to a file format is nothing new to them.

A kind that a reader or writer forgot would be free space, and what stands there would be hit. So
each that tells kinds apart keeps a table with an entry for every kind, made by `for_every_kind`,
which raises, when the module is imported, where an entry is missing.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gnnjax.errors import InputError

# In Python, in problem files (`box_centers`) and, in the plural, in scene files.
KINDS = ("box", "sphere", "capsule", "cylinder", "half_space")

# What has a table, and of which kinds; filled as the modules are imported.
TABLES: dict[str, tuple[str, ...]] = {}

IDENTITY_QUAT = (1.0, 0.0, 0.0, 0.0)
HALF_SPACE = 50.0  # m; half the edge of the box that stands for a half-space


def for_every_kind(consumer: str, **entries: Any) -> dict[str, Any]:
    """A consumer's table, keyed by kind.

    Args:
        consumer: who deals with obstacles here.
        entries: what it does with a kind, by the kind's name.

    Raises:
        TypeError: a kind without an entry, or an entry that is no kind.
    """
    if gap := set(KINDS) - entries.keys():
        raise TypeError(f"the {consumer} has no entry for obstacles of the kinds {sorted(gap)}")
    if unknown := entries.keys() - set(KINDS):
        raise TypeError(f"the {consumer} has entries for {sorted(unknown)}, which are no obstacles")
    TABLES[consumer] = tuple(entries)
    return entries


# What describes an obstacle of each kind, and how many numbers it takes. A quaternion may be left
# out; a capsule's or cylinder's axis is its z axis, and `normal` points out of a half-space.
_ROUND = {"center": 3, "radius": 1, "half_length": 1, "quat": 4}
FIELDS = for_every_kind(
    "description",
    box={"center": 3, "half_extents": 3, "quat": 4},
    sphere={"center": 3, "radius": 1},
    capsule=_ROUND,
    cylinder=_ROUND,
    half_space={"point": 3, "normal": 3},
)
SIZES = ("half_extents", "radius", "half_length")  # which must be positive
PLURALS = {
    "center": "centers",
    "half_extents": "half_extents",
    "quat": "quats",
    "radius": "radii",
    "half_length": "half_lengths",
    "point": "points",
    "normal": "normals",
    **dict(zip(KINDS, ("boxes", "spheres", "capsules", "cylinders", "half_spaces"), strict=True)),
}


class Shape(NamedTuple):
    """One obstacle as people describe it; made by `box`, `sphere`, `capsule`, ..."""

    kind: str
    values: dict[str, Sequence[float] | float | np.ndarray]  # by the names of `FIELDS`


def box(center, half_extents, quat=IDENTITY_QUAT) -> Shape:
    """A box: its centre and half its edge lengths, m; its orientation w x y z."""
    return Shape("box", {"center": center, "half_extents": half_extents, "quat": quat})


def sphere(center, radius: float) -> Shape:
    """A sphere: its centre and its radius, m."""
    return Shape("sphere", {"center": center, "radius": radius})


def capsule(center, radius: float, half_length: float, quat=IDENTITY_QUAT) -> Shape:
    """A capsule about its z axis: all within `radius` of a line of twice `half_length`, m."""
    values = {"center": center, "radius": radius, "half_length": half_length, "quat": quat}
    return Shape("capsule", values)


def cylinder(center, radius: float, half_length: float, quat=IDENTITY_QUAT) -> Shape:
    """A cylinder about its z axis, m."""
    return capsule(center, radius, half_length, quat)._replace(kind="cylinder")


def half_space(point, normal) -> Shape:
    """All that lies below a plane through `point` (m), which `normal` points out of: a floor, say.

    Arms see a box of 100 m with its face in that plane.
    """
    return Shape("half_space", {"point": point, "normal": normal})


class Sums(NamedTuple):
    """Obstacles as sums of box, disc and ball, in double precision."""

    centers: np.ndarray  # [*batch 3] m
    half_extents: np.ndarray  # [*batch 3] m
    quats: np.ndarray  # [*batch 4]
    radii: np.ndarray  # [*batch 2] m, of disc and ball


def sums_of(kind: str, values: dict[str, np.ndarray]) -> Sums:
    """Obstacles of a kind `[*batch]` as sums.

    Args:
        kind: theirs.
        values: arrays `[*batch, number]` by the names of `FIELDS`; quaternions normalized.
    """
    return _SUMS[kind](**values)


def _box(center, half_extents, quat) -> Sums:
    return Sums(center, half_extents, quat, np.zeros((*center.shape[:-1], 2)))


def _round(center, radius, half_length, quat, *, ball: bool) -> Sums:
    none = np.zeros_like(radius)
    half_extents = np.concatenate([none, none, half_length], axis=-1)
    radii = [none, radius] if ball else [radius, none]
    return Sums(center, half_extents, quat, np.concatenate(radii, axis=-1))


def _capsule(**values) -> Sums:
    return _round(**values, ball=True)


def _cylinder(**values) -> Sums:
    return _round(**values, ball=False)


def _sphere(center, radius) -> Sums:
    quat = np.zeros((*center.shape[:-1], 4))
    quat[..., 0] = 1
    return _capsule(center=center, radius=radius, half_length=np.zeros_like(radius), quat=quat)


def _half_space(point, normal) -> Sums:
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    above = np.sum(point * normal, axis=-1, keepdims=True)
    # The rotation that takes z to the normal: halfway between, unless they are opposite.
    quat = np.concatenate([1 + normal[..., 2:], -normal[..., 1:2], normal[..., :1]], axis=-1)
    quat = np.concatenate([quat, np.zeros((*quat.shape[:-1], 1))], axis=-1)
    quat = np.where(normal[..., 2:] < -1 + 1e-9, [0, 1, 0, 0], quat)
    # Its face is centered where it comes nearest to the base.
    return _box(
        (above - HALF_SPACE) * normal,
        np.full(point.shape, HALF_SPACE),
        quat / np.linalg.norm(quat, axis=-1, keepdims=True),
    )


_SUMS = for_every_kind(
    "form",
    box=_box,
    sphere=_sphere,
    capsule=_capsule,
    cylinder=_cylinder,
    half_space=_half_space,
)


def kind_of(half_extents: ArrayLike, radii: ArrayLike) -> np.ndarray:
    """The numbers in `KINDS` of obstacles `[*batch]`; -1 for a sum that is of no kind.

    Args:
        half_extents: `[*batch, 3]` m.
        radii: `[*batch, 2]` m, of disc and ball.
    """
    half_extents, radii = np.asarray(half_extents), np.asarray(radii)
    sizes = [*np.moveaxis(half_extents, -1, 0), *np.moveaxis(radii, -1, 0)]
    x, y, z, disc, ball = (np.where(size > 0, 1, np.where(size == 0, 0, -1)) for size in sizes)
    # NaN and negative sizes are -1.
    form = [x, y, z, disc, ball]
    kinds = np.full(x.shape, -1)
    for kind, wanted in _FORMS.items():
        fits = np.all([part == size for part, size in zip(form, wanted, strict=True)], axis=0)
        kinds = np.where(fits, KINDS.index(kind), kinds)
    huge = (kinds == KINDS.index("box")) & (half_extents == HALF_SPACE).all(axis=-1)
    return np.where(huge, KINDS.index("half_space"), kinds)


def known_kinds(half_extents: ArrayLike, radii: ArrayLike, mask: ArrayLike) -> np.ndarray:
    """`kind_of` obstacles `[*batch, M]`, all of which that exist are of a kind; -1 for others.

    Args:
        half_extents: `[*batch, M, 3]` m.
        radii: `[*batch, M, 2]` m, of disc and ball.
        mask: `[*batch, M]`, true where the obstacle exists.

    Raises:
        InputError: one is of no kind, such as a box that `inflated` has rounded.
    """
    mask = np.asarray(mask)
    kinds = np.where(mask, kind_of(half_extents, radii), -1)
    if len(bad := np.argwhere(mask & (kinds < 0))):
        *batch, which = bad[0].tolist()
        where = f"problem {batch[0]}" if batch else "the scene"
        raise InputError(
            f"obstacle {which} of {where} is of no kind of {list(KINDS)}; make scenes with "
            "make_scene or scene_from_shapes"
        )
    return kinds


# Which of the sizes are positive: x, y, z of the box, the disc, the ball. A half-space is told from
# a box by its size.
_FORMS = {
    "box": (1, 1, 1, 0, 0),
    "sphere": (0, 0, 0, 0, 1),
    "capsule": (0, 0, 1, 0, 1),
    "cylinder": (0, 0, 1, 1, 0),
}


def z_axis(quats: ArrayLike) -> np.ndarray:
    """Where unit quaternions `[*batch, 4]` turn z to, `[*batch, 3]`."""
    w, x, y, z = np.moveaxis(np.asarray(quats, float), -1, 0)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def described(kind: str, sums: Sums) -> dict[str, np.ndarray]:
    """What `sums_of` was given of obstacles of a kind `[*batch]`, by the names of `FIELDS`."""
    values = {
        "center": sums.centers,
        "half_extents": sums.half_extents,
        "quat": sums.quats,
        "radius": sums.radii.sum(axis=-1, keepdims=True),  # one of them is zero
        "half_length": sums.half_extents[..., 2:],
    }
    if kind == "half_space":
        normal = z_axis(sums.quats)
        values |= {"normal": normal, "point": sums.centers + HALF_SPACE * normal}
    return {name: values[name] for name in FIELDS[kind]}
