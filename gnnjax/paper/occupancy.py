"""Obstacles as the paper's network sees them: an occupancy grid and a 3D convolution over it."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from gnnjax.scene.geometry import signed_distance
from gnnjax.scene.lookup import distances_to
from gnnjax.scene.scene import Scene


def occupancy_grid(
    scene: Scene,
    lower: Sequence[float],
    upper: Sequence[float],
    grid_size: int,
) -> Float[Array, "m m m"]:
    """Draws obstacles into a grid over the workspace: 1 where a voxel's center lies in one.

    What is thinner than a voxel is drawn one voxel thick; a pillar or plate between two rows of
    centers would vanish otherwise.

    Args:
        scene: obstacles, in the frame of the robot's base.
        lower: corner of the workspace [m].
        upper: opposite corner [m].
        grid_size: voxels along each axis, the paper's m.
    """
    low, high = jnp.asarray(lower), jnp.asarray(upper)
    voxel = (high - low) / grid_size
    axes = [low[i] + voxel[i] * (jnp.arange(grid_size) + 0.5) for i in range(3)]
    centers = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    occupied = _inside(scene, centers, 0.5 * jnp.max(voxel))
    return occupied.astype(jnp.float32).reshape(grid_size, grid_size, grid_size)


def _inside(
    scene: Scene, points: Float[Array, "V 1 3"], least: Float[Array, ""]
) -> Bool[Array, " V"]:
    """Whether points are in an obstacle, each of which counts as `least` [m] thick or thicker."""
    offset = points - scene.centers  # [V M 3]
    # Rotation by the conjugate quaternion takes the offset into the frame of the obstacle.
    w, v = scene.quats[:, :1], -scene.quats[:, 1:]
    t = 2.0 * jnp.cross(v, offset)
    local = offset + w * t + jnp.cross(v, t)
    # Boxes are widened along the sides that are thin; what is round, so that
    # it holds a center wherever it lies.
    disc, ball = scene.radii.T
    is_box = (disc == 0) & (ball == 0)
    sizes = jnp.where(is_box[:, None], jnp.maximum(scene.half_extents, least), scene.half_extents)
    thin = jnp.where(disc > 0, jnp.minimum(disc, scene.half_extents[:, 2]), ball)
    widened = jnp.where(is_box, 0.0, jnp.maximum(3**0.5 * least - thin, 0.0))
    away = signed_distance(list(jnp.moveaxis(local, -1, 0)), list(sizes.T), disc, ball)
    occupied = jnp.any((away <= widened) & scene.mask, axis=-1)
    if scene.cloud is None:
        return occupied
    # A voxel's corner is that far from its center.
    return occupied | (distances_to(scene.cloud, list(points[:, 0].T)) <= 3**0.5 * least)


class HalvingConv(nnx.Module):
    """A 3 x 3 x 3 convolution of stride 2 over a cube, zero padded by one voxel on each side.

    Written as a product with 27 shifted copies of the grid: the gradient of XLA's own 3D
    convolution is tens of times slower on a CPU.
    """

    def __init__(self, in_channels: int, out_channels: int, *, rngs: nnx.Rngs):
        self.linear = nnx.Linear(27 * in_channels, out_channels, rngs=rngs)

    def __call__(self, grid: Float[Array, "m m m A"]) -> Float[Array, "n n n B"]:
        span = 2 * ((grid.shape[0] + 1) // 2) - 1
        grid = jnp.pad(grid, ((1, 1), (1, 1), (1, 1), (0, 0)))
        for axis in range(3):  # one axis after the other: 9 slices instead of 27
            shifts = [
                jax.lax.slice_in_dim(grid, start, start + span, stride=2, axis=axis)
                for start in range(3)
            ]
            grid = jnp.concatenate(shifts, axis=-1)
        return self.linear(grid)
