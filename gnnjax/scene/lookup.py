"""How kernels look clouds up: in the grid of squared distances to the nearest of their points.

Between nodes, Jensen's inequality bounds that distance from below: the least of |p - c|^2 over all
points c, less |p|^2, is concave in p, so that its mean over the corners of a cell, weighted so that
their mean is p, is no more than its value at p. For |p|^2, that mean is too large by the variance
of the corners. Where all corners have the same nearest point, the bound is exact; before a wall it
is short by the second order of a cell's size. Halfway between two walls it may be short by half a
cell's diagonal, as the nearest node's distance would be anywhere.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gnnjax.arm.kinematics import Scalar, Vector
from gnnjax.scene.cloud import NODES, REACH, Cloud


class Lookup(NamedTuple):
    """The grids of some points, each its own, or the same for all."""

    lower: list[jax.Array]  # of each axis
    cells: list[jax.Array]
    radius: jax.Array  # m, of the balls
    squared: Float[Array, " V"]  # of all grids in a row
    first: jax.Array | int  # where those of a point begin


def lookup(cloud: Cloud, owner: Int[Array, "..."] | None = None) -> Lookup:
    """How `squared_distance_to` finds the distances of points to a cloud.

    Args:
        cloud: one, or `[P, ...]`.
        owner: of each point, in which of P clouds it is looked up; None for one cloud.
    """
    if owner is None:
        return Lookup(
            list(cloud.lower), list(cloud.cells), cloud.radius, jnp.asarray(cloud.squared), 0
        )
    nodes = cloud.squared.shape[-1]
    return Lookup(
        list(jnp.moveaxis(cloud.lower[owner], -1, 0)),
        list(jnp.moveaxis(cloud.cells[owner], -1, 0)),
        cloud.radius[owner],
        cloud.squared.reshape(-1),
        owner.astype(jnp.int32) * nodes,
    )


class Corners(NamedTuple):
    """What the nodes around points tell of their distances to a cloud's points."""

    squared: list[jax.Array]  # m^2, from each of eight nodes to the nearest of the cloud's points
    away: list[tuple[Scalar, Scalar]]  # m^2, of each axis: to its lower and its upper nodes
    parts: Vector  # where between these, from 0 to 1
    extra: Scalar  # m^2
    inside: jax.Array | bool  # whether the points are in reach

    def at_least(self) -> jax.Array:
        """See `squared_distance_to`."""

        def between(low: jax.Array, high: jax.Array, part: jax.Array) -> jax.Array:
            return low + part * (high - low)

        values = self.squared
        for part in reversed(self.parts):
            values = [between(*pair, part) for pair in zip(*[iter(values)] * 2, strict=True)]
        return jnp.where(self.inside, values[0] + self.extra, -1.0)

    def are_within(self, reach: jax.Array) -> jax.Array:
        """True only where the nearest of the cloud's points is nearer than `reach` [m, not
        negative]: to a node and on to what is nearest to that is no shortcut."""
        found, most = jnp.bool_(False), reach * reach
        for squared, way in zip(self.squared, itertools.product(*self.away), strict=True):
            step = way[0] + way[1] + way[2]
            # sqrt(squared) + sqrt(step) < reach, without roots.
            left = most - squared - step
            found = found | ((left > 0.0) & (left * left > 4.0 * squared * step))
        return found


def corners_around(grid: Lookup, point: Vector) -> Corners:
    """Looks points up; see `squared_distance_to`."""
    index, parts, away, extra, inside = jnp.int32(0), [], [], 0.0, True
    for x, low, cell in zip(point, grid.lower, grid.cells, strict=True):
        inside = inside & (jnp.abs(jnp.asarray(x)) <= REACH)
        at = (x - low) / cell
        # As everywhere in such loops: `clip` would have to carry NaN.
        held = jnp.where(at > 0.0, at, 0.0)
        held = jnp.where(held < NODES - 1.0, held, NODES - 1.0)
        # The angle between the way to the box of all points and on to any is obtuse.
        beyond = (at - held) * cell
        whole = jnp.floor(jnp.where(held < NODES - 2.0, held, NODES - 2.0))
        part = held - whole
        extra = extra + beyond * beyond - cell * cell * part * (1.0 - part)
        index = index * NODES + whole.astype(jnp.int32)
        parts.append(part)
        to_low = (at - whole) * cell
        away.append((to_low * to_low, (to_low - cell) * (to_low - cell)))
    index = index + grid.first

    def corner(offset: int) -> jax.Array:
        return grid.squared.at[index + offset].get(mode="promise_in_bounds")

    offsets = [(i * NODES + j) * NODES + k for i, j, k in itertools.product((0, 1), repeat=3)]
    return Corners([corner(offset) for offset in offsets], away, parts, extra, inside)


def squared_distance_to(grid: Lookup, point: Vector) -> jax.Array:
    """No more than the squared distance [m^2] of points to the centres of a cloud's balls, and less
    by a cell's diagonal times the sum of the distance and a quarter of it at most; negative where
    nothing is known.

    Args:
        grid: of `lookup`.
        point: three arrays, m.
    """
    return corners_around(grid, point).at_least()


def distances_to(cloud: Cloud, point: Vector) -> jax.Array:
    """No more than the distances [m] of points to the balls of a cloud; minus the radius, or less,
    is as deep as it gets.

    Args:
        cloud: one.
        point: three arrays, m.
    """
    squared = squared_distance_to(lookup(cloud), point)
    return jnp.sqrt(jnp.where(squared > 0.0, squared, 0.0)) - cloud.radius
