"""Distance fields: how far the obstacles of a scene are, on a grid over the arm's reach.

Whoever reads a field instead of the obstacles pays one look-up, however many obstacles there are.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gnnjax.arm.kinematics import Vector
from gnnjax.scene.geometry import signed_distance
from gnnjax.scene.lookup import distances_to
from gnnjax.scene.scene import Scene, last_obstacle, rotation_matrices

_FAR = 10.0  # m; what a scene without obstacles is away from everything


class Grid(NamedTuple):
    """Cubic cells over a box in the frame of the arm's base."""

    lower: tuple[float, float, float]  # m, the corner of the first cell
    cell: float  # m
    shape: tuple[int, int, int]

    @property
    def num_cells(self) -> int:
        """V."""
        return int(np.prod(self.shape))


def make_grid(lower: np.ndarray, upper: np.ndarray, cells: int) -> Grid:
    """A grid with `cells` cells along the longest side of a box `[3]` to `[3]`, m."""
    cell = float((upper - lower).max() / cells)
    shape = np.maximum(1, np.ceil((upper - lower) / cell - 1e-6)).astype(int)
    return Grid(tuple(lower.tolist()), cell, tuple(shape.tolist()))


def cell_of(grid: Grid, point: Vector) -> Int[Array, "..."]:
    """The flat index of the cell that a point is in; of the nearest one outside of the grid.

    Args:
        grid: of the field.
        point: three arrays, m.
    """
    index: Int[Array, ...] | int = 0
    for x, low, size in zip(point, grid.lower, grid.shape, strict=True):
        at = (jnp.asarray(x, jnp.float32) - low) / grid.cell - 0.5
        # As everywhere in such loops: `clip` would have to carry NaN.
        at = jnp.where(at < 0.0, 0.0, at)
        at = jnp.where(at > size - 1.0, size - 1.0, at)
        index = index * size + jnp.round(at).astype(jnp.int32)
    return jnp.asarray(index)


def distance_field(grid: Grid) -> Callable[[Scene], Float[Array, " V"]]:
    """Makes the function `scene -> [V]`: signed distances [m] of the cells' centres to the nearest
    obstacle, negative inside of it; no more than that to a cloud.
    """
    sides = [
        (low + (np.arange(size) + 0.5) * grid.cell).astype(np.float32)
        for low, size in zip(grid.lower, grid.shape, strict=True)
    ]
    x, y, z = sides[0][:, None, None], sides[1][None, :, None], sides[2][None, None, :]

    def field(scene: Scene) -> Float[Array, " V"]:
        turned = jnp.swapaxes(rotation_matrices(scene.quats), -1, -2)  # base to obstacle

        def nearer(i: jax.Array, nearest: jax.Array) -> jax.Array:
            offset = [side - scene.centers[i, a] for a, side in enumerate((x, y, z))]
            seen = [sum(turned[i, r, a] * offset[a] for a in range(3)) for r in range(3)]
            away = signed_distance(seen, list(scene.half_extents[i]), *scene.radii[i])
            return jnp.where(scene.mask[i] & (away < nearest), away, nearest)

        nearest = jnp.full(grid.shape, _FAR, jnp.float32)
        if scene.cloud is not None:
            away = distances_to(scene.cloud, [jnp.asarray(side) for side in (x, y, z)])
            nearest = jnp.where(away < nearest, away, nearest)
        return jax.lax.fori_loop(0, last_obstacle(scene.mask), nearer, nearest).ravel()

    return field
