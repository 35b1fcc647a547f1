"""The distance field as a guide: how far is the arm from the obstacles, on the way?

The field of a scene is read at the centres of the arm's collision spheres. What is left of the
least distance once the sphere's radius is taken off, the margin, tells free motions from blocked
ones better than the motion network does, at a fraction of the work and without training.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gnnjax.arm.kinematics import body_frames, joint_terms, transform
from gnnjax.arm.robot import CAPSULE, Robot, require_round_geoms
from gnnjax.collision.fused import moved_by_joint
from gnnjax.guide.guide import Guide, Prices
from gnnjax.roadmap.graph import Roadmap
from gnnjax.scene.field import Grid, cell_of, distance_field, make_grid

CELLS = 24  # along the longest side of the grid
SPACING = 0.35  # rad (or m) between the places of a motion that are looked at
# m: the margin at which a motion is as likely free as not, and how fast that changes. Of five pairs
# these need the fewest checks on 552 public Kuka problems (numbers 500 to 1099).
CALIBRATION = (0.01, 0.012)
_SPHERES_A_PASS = 8
_BLOCK = 256  # places that are looked at at once


class _Spheres(NamedTuple):
    """Spheres that cover what moves of the arm, S."""

    bodies: tuple[int, ...]
    centers: np.ndarray  # [S 3] m, in the body's frame
    radii: np.ndarray  # [S] m


def _spheres(robot: Robot) -> _Spheres:
    """The arm's moving geoms; capsules as chains of spheres."""
    require_round_geoms(robot)
    bodies, centers, radii = [], [], []
    for g in np.flatnonzero(moved_by_joint(robot)):
        steps, radius = np.zeros(1), float(robot.geom_radii[g])
        if robot.geom_types[g] == CAPSULE:
            length = 2 * np.linalg.norm(robot.geom_axes[g])
            steps = np.linspace(-1, 1, int(np.ceil(length / radius)) + 1)
        for step in steps:
            bodies.append(int(robot.geom_bodies[g]))
            centers.append(robot.geom_centers[g] + step * robot.geom_axes[g])
            radii.append(radius)
    return _Spheres(tuple(bodies), np.array(centers), np.array(radii))


def reach_grid(robot: Robot, cells: int = CELLS) -> Grid:
    """A grid over what the centres of the arm's spheres reach, seen at random configurations."""
    spheres = _spheres(robot)
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (4096, robot.num_dof)).astype(np.float32)
    centers = np.asarray(jax.jit(lambda q: jnp.stack(_centers(robot, spheres, q)))(q))  # [S 3 B]
    return make_grid(centers.min((0, 2)), centers.max((0, 2)), cells)


def _centers(robot: Robot, spheres: _Spheres, q: jax.Array) -> list[jax.Array]:
    frames = body_frames(robot, joint_terms(robot, q))
    full = q.shape[:-1]
    return [
        jnp.stack([jnp.broadcast_to(x, full) for x in transform(*frames[body], center.tolist())])
        for body, center in zip(spheres.bodies, spheres.centers, strict=True)
    ]


def margin_function(robot: Robot, grid: Grid) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Makes the function `(field [V], q [B D]) -> [B]`: margins [m] of configurations."""
    spheres = _spheres(robot)

    def margin(field: Float[Array, " V"], q: Float[Array, "B D"]) -> Float[Array, " B"]:
        joints = joint_terms(robot, q)
        smallest = jnp.full(q.shape[:1], jnp.inf, q.dtype)
        for first in range(0, len(spheres.radii), _SPHERES_A_PASS):
            chosen = range(first, min(first + _SPHERES_A_PASS, len(spheres.radii)))

            def look(_, smallest, chosen=chosen):
                # As in the collision kernels: kinematics anew in each pass, or the positions of
                # all spheres would go through memory, which is eight times slower.
                fresh, smallest = jax.lax.optimization_barrier((joints, smallest))
                frames = body_frames(robot, fresh)
                for s in chosen:
                    point = transform(*frames[spheres.bodies[s]], spheres.centers[s].tolist())
                    left = field[cell_of(grid, point)] - float(spheres.radii[s])
                    smallest = jnp.where(left < smallest, left, smallest)
                return smallest

            smallest = jax.lax.fori_loop(0, 1, look, smallest)
        return smallest

    return margin


class EdgeTable(NamedTuple):
    """What the edges of a stored roadmap come by, computed once an arm.

    Spheres at neighbouring places are often in the same cell; of those, the largest counts.
    """

    cells: Int[Array, "E W"]  # repeated where an edge has fewer
    radii: Float[Array, "E W"]  # m
    edge: Int[Array, "N K"]  # of each slot; E on padding


def edge_table(robot: Robot, grid: Grid, roadmap: Roadmap) -> EdgeTable:
    """The cells and radii of all edges of a roadmap, at places at most `SPACING` apart."""
    spheres = _spheres(robot)
    nodes, neighbors = np.asarray(roadmap.nodes), np.asarray(roadmap.neighbors)
    own = np.arange(len(nodes))[:, None]
    first, slot = np.nonzero(np.asarray(roadmap.neighbor_mask) & (own < neighbors))
    second = neighbors[first, slot]
    number = np.full((len(nodes), len(nodes)), len(first), np.int32)
    number[first, second] = number[second, first] = np.arange(len(first))
    longest = np.linalg.norm(nodes[second] - nodes[first], axis=1).max(initial=0.0)
    fraction = np.linspace(0, 1, int(np.ceil(longest / SPACING)) + 1, dtype=np.float32)[:, None]
    rows = []
    visit = jax.jit(
        lambda q: jnp.stack([cell_of(grid, list(c)) for c in _centers(robot, spheres, q)])
    )
    ends = nodes[first][:, None], nodes[second][:, None]
    places = ends[0] + fraction * (ends[1] - ends[0])  # [E F D]
    seen = np.asarray(visit(jnp.asarray(places.reshape(-1, nodes.shape[1]))))  # [S EF]
    shape = len(spheres.radii), len(first), len(fraction)
    seen = np.moveaxis(seen.reshape(shape), 1, 0)  # [E S F]
    radii = np.broadcast_to(spheres.radii[:, None], seen.shape[1:]).ravel()
    descending = np.argsort(-radii, kind="stable")
    for row in seen.reshape(len(first), radii.size):
        cells, at = np.unique(row[descending], return_index=True)
        rows.append((cells, radii[descending][at]))
    width = max((len(cells) for cells, _ in rows), default=1)
    table = EdgeTable(
        np.zeros((len(rows), width), np.int32),
        np.zeros((len(rows), width), np.float32),
        np.where(roadmap.neighbor_mask, number[own, neighbors], len(rows)).astype(np.int32),
    )
    for i, (cells, r) in enumerate(rows):
        table.cells[i], table.radii[i] = np.resize(cells, width), np.resize(r, width)
    return jax.tree.map(jnp.asarray, table)


def field_guide(robot: Robot, cells: int = CELLS) -> Guide:
    """The distance field as a guide for an arm.

    Args:
        robot: the arm.
        cells: of the field, along the longest side of its grid.
    """
    grid = reach_grid(robot, cells)
    field, margin = distance_field(grid), margin_function(robot, grid)

    def price(weights: jax.Array, margins: jax.Array) -> jax.Array:
        return jax.nn.softplus((weights[0] - margins) / weights[1])

    def prices(weights: jax.Array, reading: Float[Array, " V"]) -> Prices:
        def nodes(q: Float[Array, "B D"]) -> Float[Array, " B"]:
            return price(weights, margin(reading, q))

        def motions(
            starts: Float[Array, "E D"], ends: Float[Array, "E D"], most: int
        ) -> Float[Array, " E"]:
            # Places of all motions in a row, as many as each needs, looked at block by block.
            length = jnp.linalg.norm(ends - starts, axis=-1)
            pieces = jnp.clip(jnp.ceil(length / SPACING), 1, most).astype(jnp.int32)
            last = jnp.cumsum(pieces + 1)

            def look(i: jax.Array, smallest: jax.Array) -> jax.Array:
                place = i * _BLOCK + jnp.arange(_BLOCK)
                motion = jnp.searchsorted(last, place, side="right")
                at = jnp.minimum(motion, len(starts) - 1)
                step = place - (last[at] - pieces[at] - 1)
                fraction = (step / pieces[at])[:, None]
                margins = margin(reading, starts[at] + fraction * (ends[at] - starts[at]))
                return smallest.at[motion].min(margins, mode="drop")

            blocks = (last[-1] + _BLOCK - 1) // _BLOCK
            smallest = jnp.full(len(starts), jnp.inf)
            return price(weights, jax.lax.fori_loop(0, blocks, look, smallest))

        return Prices(nodes, motions)

    def stored(
        weights: jax.Array, readings: Float[Array, "P V"], table: EdgeTable
    ) -> Float[Array, "P N K"]:
        # The problems come last, so that a look-up reads a row of them at once: ten times faster.
        cells = readings.T

        def look(i: jax.Array, smallest: jax.Array) -> jax.Array:
            left = cells[table.cells[:, i]] - table.radii[:, i, None]
            return jnp.where(left < smallest, left, smallest)

        shape = len(table.cells), len(readings)
        margins = jax.lax.fori_loop(0, table.cells.shape[1], look, jnp.full(shape, jnp.inf))
        edges = jnp.pad(price(weights, margins), ((0, 1), (0, 0)))
        return jnp.moveaxis(edges[table.edge], -1, 0)

    return Guide(
        jnp.array(CALIBRATION),
        lambda weights, scene: field(scene),
        prices,
        functools.partial(edge_table, robot, grid),
        stored,
    )
