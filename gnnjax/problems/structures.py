"""What families of scenes are made of: structures in frames of their own, and regions of the tip.

All lengths are in units of the arm's reach, and the origin is the middle of its workspace, so that
a family makes sense for an arm of any size; z points up. A structure is drawn in a frame of its
own, whose x axis points away from the arm, and then put somewhere around it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gnnjax.scene.scene import Scene, box_scene, obstacle_bucket, rotation_matrices

THIN = 0.012  # half the thickness of walls and boards
FAR = 2.0  # beyond all that the arm reaches
MARGIN = 0.04  # of the tip to walls; most arms are thicker than that


class Region(NamedTuple):
    """An oriented box in which the arm's tip must be."""

    center: Float[Array, "*batch 3"]
    half_extents: Float[Array, "*batch 3"]
    quat: Float[Array, "*batch 4"]  # w x y z, region to world


class FamilyScene(NamedTuple):
    """A scene, and where the tip starts and ends in it."""

    scene: Scene
    start: Region
    goal: Region
    # What a depth camera sees, and then stands for the scene; rays that hit nothing are NaN.
    seen: Float[Array, "*batch K 3"] | None = None
    # rad; how far what the arm holds may be from upright at start and goal. None: it holds nothing.
    tilt: Float[Array, "*batch"] | None = None


class Placement(NamedTuple):
    """Where a structure's frame is."""

    position: Float[Array, "3"]
    quat: Float[Array, "4"]


def uniform(key: jax.Array, low: list, high: list, *shape: int) -> jax.Array:
    """Numbers `[*shape, N]` between N bounds."""
    bounds = jnp.array(low), jnp.array(high)
    return jax.random.uniform(key, (*shape, len(low)), minval=bounds[0], maxval=bounds[1])


def beside_arm(
    key: jax.Array, distance: jax.Array, height: jax.Array | float, *, tilt: float = 0.0
) -> Placement:
    """A frame somewhere around the arm, whose x axis points away from it give or take 0.3 rad."""
    around_key, swing_key, tilt_key = jax.random.split(key, 3)
    around = jax.random.uniform(around_key, (), minval=-jnp.pi, maxval=jnp.pi)
    swing = jax.random.uniform(swing_key, (), minval=-0.3, maxval=0.3)
    roll, pitch = jax.random.uniform(tilt_key, (2,), minval=-tilt, maxval=tilt)
    position = jnp.stack([distance * jnp.cos(around), distance * jnp.sin(around), height + 0.0])
    lean = multiply(about(0, roll), about(1, pitch))
    return Placement(position, multiply(about(2, around + swing), lean))


def about(axis: int, angle: jax.Array) -> jax.Array:
    """The quaternion of a turn about a coordinate axis."""
    return jnp.zeros(4).at[0].set(jnp.cos(angle / 2)).at[axis + 1].set(jnp.sin(angle / 2))


def unit(vectors: jax.Array) -> jax.Array:
    """Vectors `[*batch, N]` of length 1."""
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """The quaternion of turn b followed by turn a."""
    vector = a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])
    return jnp.concatenate([(a[0] * b[0] - a[1:] @ b[1:])[None], vector])


def to_world(pose: Placement, points: jax.Array) -> jax.Array:
    """Points `[*batch, 3]` of a structure's frame in the world."""
    return pose.position + points @ rotation_matrices(pose.quat).T


def _corners(low: list, high: list) -> tuple[jax.Array, jax.Array]:
    first, last = (jnp.stack([jnp.asarray(x, jnp.float32) for x in end]) for end in (low, high))
    return (first + last) / 2, (last - first) / 2


def region_between(pose: Placement, low: list, high: list) -> Region:
    """The region between two corners in a structure's frame."""
    center, half_extents = _corners(low, high)
    return Region(to_world(pose, center), half_extents, pose.quat)


def boxes_between(pose: Placement, low_high: list, exists: Bool[Array, " M"]) -> Scene:
    """Boxes between pairs of corners in a structure's frame."""
    parts = [_corners(low, high) for low, high in low_high]
    centers, half_extents = (jnp.stack(part) for part in zip(*parts, strict=True))
    quats = jnp.tile(pose.quat, (len(parts), 1))
    return box_scene(to_world(pose, centers), half_extents, quats, exists)


def cylinders(
    pose: Placement, centers: jax.Array, radius: jax.Array, half: jax.Array, exists: jax.Array
) -> Scene:
    """Cylinders along the z axis of a structure's frame."""
    quats = jnp.tile(pose.quat, (len(centers), 1))
    return round_ones(to_world(pose, centers), radius, half, quats, jnp.zeros_like(exists), exists)


def round_ones(
    centers: jax.Array,
    radius: jax.Array,
    half: jax.Array,
    quats: jax.Array,
    is_capsule: jax.Array,
    exists: jax.Array,
) -> Scene:
    """Cylinders, or capsules, about their z axes."""
    none = jnp.zeros_like(radius)
    half_extents = jnp.stack([none, none, half], axis=1)
    scene = box_scene(centers, half_extents, quats, exists)
    disc, ball = jnp.where(is_capsule, 0, radius), jnp.where(is_capsule, radius, 0)
    return scene._replace(radii=jnp.stack([disc, ball], axis=1))


def joined(*scenes: Scene) -> Scene:
    """Joins scenes, and pads them to a box bucket."""
    joined = jax.tree.map(lambda *x: jnp.concatenate(x), *scenes)
    missing = obstacle_bucket(len(joined.mask)) - len(joined.mask)
    blank = box_scene(
        jnp.zeros((missing, 3)),
        jnp.full((missing, 3), 0.1),
        jnp.tile(about(2, jnp.zeros(())), (missing, 1)),
        jnp.zeros(missing, bool),
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), joined, blank)


def choose(first: jax.Array, a: Region, b: Region) -> Region:
    """a where `first` is true, else b."""
    return jax.tree.map(lambda x, y: jnp.where(first, x, y), a, b)


def swapped(key: jax.Array, a: Region, b: Region) -> tuple[Region, Region]:
    """Start and goal in either order."""
    first = jax.random.bernoulli(key)
    return choose(first, a, b), choose(first, b, a)
