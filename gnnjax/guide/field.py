"""The distance field as a guide: how far is the arm from the obstacles, on the way?

The field of a scene is read at the centres of the arm's collision spheres. What is left of the
least distance once the sphere's radius is taken off, the margin, tells free motions from blocked
ones better than the motion network does, at a fraction of the work and without training.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gnnjax.arm.kinematics import body_frames, joint_terms, transform_point
from gnnjax.arm.robot import Robot
from gnnjax.collision.bounds import spheres_of
from gnnjax.collision.link_frames import joint_frames, of_links, place
from gnnjax.collision.spheres import moved_by_joint
from gnnjax.guide.guide import Guide, Prices
from gnnjax.kept import keep
from gnnjax.roadmap.graph import Roadmap, each_edge, edge_numbers
from gnnjax.scene.field import Grid, cell_of, distance_field, make_grid

CELLS = 24  # along the longest side of the grid
SPACING = 0.35  # rad (or m) between the places of a motion that are looked at
# m: the margin at which a motion is as likely free as not, and how fast that changes. Of five pairs
# these need the fewest checks on 552 public Kuka problems (numbers 500 to 1099).
CALIBRATION = (0.01, 0.012)
_SPHERES_A_PASS = 8
_BLOCK = 256  # places that are looked at at once
_EDGES = 256  # of a stored roadmap, looked at at once
_PADDED = 1024, 128  # what edges and cells of a table are padded to multiples of
_PLACES = 4096  # configurations whose spheres are placed at once, for grids and tables


class _Spheres(NamedTuple):
    """Spheres that cover what moves of the arm, S."""

    bodies: tuple[int, ...]
    centers: np.ndarray  # [S 3] m, in the body's frame
    radii: np.ndarray  # [S] m


def _spheres(robot: Robot) -> _Spheres:
    moving = np.flatnonzero(moved_by_joint(robot))
    bodies = tuple(robot.sphere_bodies[moving].tolist())
    return _Spheres(bodies, robot.sphere_centers[moving], robot.sphere_radii[moving])


def reach_grid(robot: Robot, cells: int = CELLS) -> Grid:
    """A grid over what the centres of the arm's spheres reach, seen at random configurations."""
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (_PLACES, robot.num_dof))
    centers = _placed_centers(robot, q)
    return make_grid(centers.min((1, 2)), centers.max((1, 2)), cells)


def _placed_centers(robot: Robot, q: Float[np.ndarray, "B D"]) -> Float[np.ndarray, "3 S B"]:
    """Centres of the spheres that move, m. In NumPy: once an arm, compiling takes far longer."""
    spheres, body = _spheres(robot), spheres_of(robot)
    frames = of_links(body, joint_frames(body, q.T.astype(float)))
    link = np.searchsorted(body.links, spheres.bodies)
    return place(frames[:, :, link], spheres.centers.T[..., None]).astype(np.float32)


@functools.lru_cache(maxsize=8)
def _compiled_cells(grid: Grid) -> Callable[[np.ndarray], jax.Array]:
    """Makes the function `[3 S B] -> [S B]`: the cells of points."""
    return keep(lambda points: cell_of(grid, list(points)))


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
                    point = transform_point(*frames[spheres.bodies[s]], spheres.centers[s].tolist())
                    left = field[cell_of(grid, point)] - float(spheres.radii[s])
                    smallest = jnp.where(left < smallest, left, smallest)
                return smallest

            smallest = jax.lax.fori_loop(0, 1, look, smallest)
        return smallest

    return jax.jit(margin, inline=True)  # traced once for all that look at as many places


class EdgeTable(NamedTuple):
    """What the edges of a stored roadmap come by, computed once an arm.

    Spheres at neighbouring places are often in the same cell; of those, the largest counts. Edges
    are in blocks of `_EDGES`, those that come by most cells first. Sizes are padded, so that what
    is compiled for one roadmap does for the next.
    """

    keys: Int[Array, "G W E"]  # cell times number of radii, plus number of the radius
    width: Int[Array, " G"]  # keys of the edges of a block; those of shorter ones are repeated
    edge: Int[Array, "N K"]  # of each slot, counted over all blocks; none on padding


def edge_table(robot: Robot, grid: Grid, roadmap: Roadmap) -> EdgeTable:
    """The cells and radii of all edges of a roadmap, at places at most `SPACING` apart."""
    spheres = _spheres(robot)
    nodes, edges = np.asarray(roadmap.nodes), each_edge(roadmap)
    starts, ends = nodes[edges.first], nodes[edges.second]
    longest = np.linalg.norm(ends - starts, axis=1).max(initial=0.0)
    fraction = np.linspace(0, 1, int(np.ceil(longest / SPACING)) + 1, dtype=np.float32)[:, None]
    places = starts[:, None] + fraction * (ends - starts)[:, None]
    places = places.reshape(-1, nodes.shape[1])  # [EF D]
    # In blocks of one shape, which is compiled once for all roadmaps.
    padded = np.pad(places, ((0, -len(places) % _PLACES), (0, 0)))
    seen = np.zeros((len(spheres.radii), len(padded)), np.int32)  # [S EF]
    for at in range(0, len(padded), _PLACES):
        block = slice(at, at + _PLACES)
        seen[:, block] = _compiled_cells(grid)(_placed_centers(robot, padded[block]))
    seen = seen[:, : len(places)].reshape(len(seen), len(starts), len(fraction))
    keys, count = _keys(np.moveaxis(seen, 1, 0), spheres.radii)
    order = np.argsort(-count, kind="stable")
    blocks = -(-len(order) // _EDGES)
    padded = [
        -(-max(1, n) // m) * m for n, m in zip((len(order), keys.shape[1]), _PADDED, strict=True)
    ]
    table = np.zeros(padded, np.int32)
    table[: len(order), : keys.shape[1]] = keys[order]
    width = np.zeros(padded[0] // _EDGES, np.int32)
    width[:blocks] = count[order][::_EDGES]
    rank = np.empty(len(order) + 1, np.int32)
    rank[order], rank[-1] = np.arange(len(order)), padded[0]
    edge = rank[edge_numbers(roadmap, edges)]
    table = table.reshape(-1, _EDGES, padded[1]).swapaxes(1, 2)
    return jax.device_put(EdgeTable(table, width, edge))


def _keys(seen: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keys `[E W]` of the distinct cells of each edge with the largest radius there, from the first
    on again where an edge has fewer than others; and how many there are, `[E]`.

    Args:
        seen: `[E S F]` cells that spheres are in.
        radii: `[S]` m.
    """
    distinct, number = _distinct(radii)
    keys = seen * np.int32(len(distinct)) + number[:, None].astype(np.int32)
    keys = np.sort(keys.reshape(len(seen), math.prod(seen.shape[1:])), axis=1)
    is_first = np.diff(keys // np.int32(len(distinct)), axis=1, prepend=-1) > 0
    count = is_first.sum(axis=1)
    begin = np.cumsum(count) - count
    at = begin[:, None] + np.arange(count.max(initial=1)) % np.maximum(count, 1)[:, None]
    return keys[is_first][at], count


def _distinct(radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The radii there are, the largest first, and of each sphere the number of its own."""
    distinct, number = np.unique(-radii, return_inverse=True)
    return -distinct.astype(np.float32), number


def field_guide(robot: Robot, cells: int = CELLS) -> Guide:
    """The distance field as a guide for an arm.

    Args:
        robot: the arm.
        cells: of the field, along the longest side of its grid.
    """
    grid = reach_grid(robot, cells)
    field, margin = distance_field(grid), margin_function(robot, grid)
    radii = jax.device_put(_distinct(_spheres(robot).radii)[0])

    def price(weights: jax.Array, margins: jax.Array) -> jax.Array:
        return jax.nn.softplus((weights[0] - margins) / weights[1])

    def prices(weights: jax.Array, reading: Float[Array, " V"]) -> Prices:
        def nodes(q: Float[Array, "B D"]) -> Float[Array, " B"]:
            return price(weights, margin(reading, q))

        def motions(
            starts: Float[Array, "E D"], ends: Float[Array, "E D"], most: int
        ) -> Float[Array, " E"]:
            length = jnp.linalg.norm(ends - starts, axis=-1)
            pieces = jnp.clip(jnp.ceil(length / SPACING), 1, most).astype(jnp.int32)

            # Places of all motions in a row, as many as each needs, looked at block by block.
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

        def block(g: jax.Array, margins: jax.Array) -> jax.Array:
            def look(i: jax.Array, smallest: jax.Array) -> jax.Array:
                key = table.keys[g, i]
                left = cells[key // len(radii)] - radii[key % len(radii), None]
                return jnp.where(left < smallest, left, smallest)

            # Of few edges, so that what is smallest so far stays near the processor.
            smallest = jnp.full((_EDGES, len(readings)), jnp.inf)
            smallest = jax.lax.fori_loop(0, table.width[g], look, smallest)
            return jax.lax.dynamic_update_slice(margins, smallest, (g * _EDGES, 0))

        margins = jnp.full((table.width.size * _EDGES, len(readings)), jnp.inf)
        margins = jax.lax.fori_loop(0, jnp.sum(table.width > 0), block, margins)
        edges = jnp.pad(price(weights, margins), ((0, 1), (0, 0)))
        return jnp.moveaxis(edges[table.edge], -1, 0)

    return Guide(
        jax.device_put(np.array(CALIBRATION, np.float32)),
        lambda weights, scene: field(scene),
        prices,
        functools.partial(edge_table, robot, grid),
        stored,
    )
