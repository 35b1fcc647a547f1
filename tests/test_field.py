"""Distance fields and the guide that reads them: against NumPy and MuJoCo's C engine, and laws."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import rankdata

from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.collision.spheres import moved_by_joint
from gnnjax.guide.field import (
    CALIBRATION,
    SPACING,
    _keys,
    field_guide,
    margin_function,
    reach_grid,
)
from gnnjax.roadmap.stored import stored_roadmap
from gnnjax.scene.field import Grid, cell_of, distance_field, make_grid
from gnnjax.scene.scene import make_scene
from tests.draws import random_configurations
from tests.fine_scan import random_scene

GRID = Grid((-0.5, -0.4, 0.1), 0.1, (10, 7, 5))


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def grid(robot):
    return reach_grid(robot)


@pytest.fixture(scope="module")
def read(grid):
    return jax.jit(distance_field(grid))


@pytest.fixture(scope="module")
def margin(robot, grid):
    return jax.jit(margin_function(robot, grid))


@pytest.fixture(scope="module")
def stored(robot):
    return stored_roadmap(robot, 60, 0)


@pytest.fixture(scope="module")
def guide(robot):
    return field_guide(robot)


@pytest.fixture(scope="module")
def table(guide, stored):
    return guide.tabulate(stored)


@pytest.fixture(scope="module")
def readings(read):
    rng = np.random.default_rng(5)
    return jnp.stack([read(random_scene(rng)) for _ in range(3)])


@pytest.fixture(scope="module")
def prices(guide, stored, table, readings):
    price = jax.jit(guide.stored)
    return price, np.asarray(price(guide.weights, readings, table))


def centers_of(grid):
    """`[V 3]` m."""
    index = np.stack(np.unravel_index(np.arange(grid.num_cells), grid.shape), axis=1)
    return np.array(grid.lower) + (index + 0.5) * grid.cell


def plain_field(scene, points):
    """Signed distances of points to the boxes that exist, box by box in double precision."""
    nearest = np.full(len(points), 10.0)
    for i in np.flatnonzero(scene.mask):
        w, *xyz = np.asarray(scene.quats[i], float)
        seen = Rotation.from_quat([*xyz, w]).inv().apply(points - scene.centers[i])
        closest = np.clip(seen, -scene.half_extents[i], scene.half_extents[i])
        inside = (scene.half_extents[i] - np.abs(seen)).min(axis=1)
        outside = np.linalg.norm(seen - closest, axis=1)
        nearest = np.minimum(nearest, np.where(inside > 0, -inside, outside))
    return nearest


def test_a_field_is_the_distance_to_the_boxes_that_exist():
    rng, read = np.random.default_rng(0), jax.jit(distance_field(GRID))
    points, inside = centers_of(GRID), 0
    for number in range(6):
        quats = rng.normal(size=(5, 4)) if number % 2 else None
        centers, sizes = rng.uniform(-0.5, 0.5, (5, 3)), rng.uniform(0.05, 0.3, (5, 3))
        scene = make_scene(centers, sizes, quats)  # padded to ten
        # Holes, up to a scene whose last box alone exists.
        scene = scene._replace(mask=scene.mask & (rng.random(10) < 1 - 0.2 * number))
        scene.mask[4] = True
        field, expected = np.asarray(read(scene)), plain_field(scene, points)
        np.testing.assert_allclose(field, expected, atol=2e-6)
        inside += (expected < 0).sum()
    assert 50 < inside < 3 * GRID.num_cells


def test_a_scene_without_boxes_is_ten_meters_away():
    read = jax.jit(distance_field(GRID))
    hidden = make_scene([[0, 0, 0.3]], [[0.2] * 3])._replace(mask=np.zeros(10, bool))
    for scene in (make_scene([], []), hidden):
        np.testing.assert_array_equal(read(scene), np.full(GRID.num_cells, 10, np.float32))


def test_neighboring_cells_differ_by_no_more_than_their_distance(grid, readings):
    for field in np.asarray(readings).reshape(-1, *grid.shape):
        for axis in range(3):
            assert np.abs(np.diff(field, axis=axis)).max() <= grid.cell + 1e-6
    assert np.ptp(readings) > 5 * grid.cell


def test_a_grid_has_cubes_that_cover_its_box():
    grid = make_grid(np.array([-1.0, 0.0, 0.5]), np.array([1.0, 0.7, 0.5]), 8)
    assert grid == Grid((-1.0, 0.0, 0.5), 0.25, (8, 3, 1))
    assert grid.num_cells == 24


def test_a_point_is_in_the_cell_whose_center_is_nearest():
    rng, centers = np.random.default_rng(1), centers_of(GRID)
    points = rng.uniform(centers.min(0) - 0.3, centers.max(0) + 0.3, (400, 3)).astype(np.float32)
    found = np.asarray(cell_of(GRID, list(jnp.asarray(points.T))))
    apart = np.linalg.norm(points[:, None] - centers, axis=-1)
    inside = (np.abs(points - centers.mean(0)) < np.array(GRID.shape) * GRID.cell / 2).all(axis=1)
    assert 50 < inside.sum() < 350
    np.testing.assert_allclose(apart[np.arange(400), found], apart.min(axis=1), atol=1e-6)
    np.testing.assert_array_equal(
        cell_of(GRID, list(jnp.asarray(centers.T))), np.arange(GRID.num_cells)
    )
    # Not a number leads to a cell all the same, as look-ups must stay in the field.
    assert 0 <= int(cell_of(GRID, [jnp.nan, 1e30, -1e30])) < GRID.num_cells


def sphere_places(robot, q):
    """Where MuJoCo has the centres `[B G 3]` of the moving spheres, m, and their radii."""
    data, rows = mujoco.MjData(robot.mj_model), np.flatnonzero(moved_by_joint(robot))
    bodies, places = robot.sphere_bodies[rows] + 1, []  # the first of MuJoCo's is the world
    for row in np.asarray(q, float):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.mj_model, data)
        turns = data.xmat.reshape(-1, 3, 3)[bodies]
        turned = np.einsum("sij,sj->si", turns, robot.sphere_centers[rows])
        places.append(data.xpos[bodies] + turned)
    return np.array(places), robot.sphere_radii[rows]


def plain_margins(grid, field, centers, radii):
    """Margins `[...]` of spheres `[... S 3]`, read by NumPy: the least and largest that rounding
    allows, since a centre may lie next to the border of cells."""
    field = np.asarray(field).reshape(grid.shape)
    seen = []
    for shift in np.ndindex(2, 2, 2):
        moved = centers + (np.array(shift) - 0.5) * 4e-6
        index = np.floor((moved - grid.lower) / grid.cell).astype(int)
        index = np.clip(index, 0, np.array(grid.shape) - 1)
        seen.append(field[tuple(np.moveaxis(index, -1, 0))] - radii)
    return tuple(side(seen, axis=0).min(axis=-1) for side in (np.min, np.max))


def test_margins_are_what_mujoco_and_the_field_say(robot, grid, margin, readings):
    q = random_configurations(np.random.default_rng(2), robot, 300)
    centers, radii = sphere_places(robot, q)
    for field in readings:
        least, most = plain_margins(grid, field, centers, radii)
        found = np.asarray(margin(field, q))
        assert (found >= least - 1e-6).all()
        assert (found <= most + 1e-6).all()
        assert (least == most).mean() > 0.99
        assert (found < 0).any()
        assert (found > 0).any()


def test_the_grid_holds_whatever_the_arm_reaches(robot, grid):
    centers, _ = sphere_places(robot, random_configurations(np.random.default_rng(3), robot, 500))
    outside = np.maximum(grid.lower - centers, 0)
    upper = np.array(grid.lower) + np.array(grid.shape) * grid.cell
    outside = np.maximum(outside, centers - upper)
    assert outside.max() < grid.cell / 2
    assert max(grid.shape) == 24
    # No side is longer than what is reached, by more than a cell.
    assert (np.ptp(centers, axis=(0, 1)) > upper - grid.lower - 2 * grid.cell).all()


def softplus(margins):
    even, scale = CALIBRATION
    return np.logaddexp(0, (even - margins) / scale)


def test_stored_prices_are_those_of_the_places_along_each_edge(
    robot, grid, stored, readings, prices
):
    nodes, neighbors = np.asarray(stored.nodes), np.asarray(stored.neighbors)
    first, slot = np.nonzero(stored.neighbor_mask)
    lengths = np.asarray(stored.lengths)[first, slot]
    pieces = int(np.ceil(lengths.max() / SPACING))
    assert pieces > 2
    # Of both directions the smaller node comes first: the very same floats.
    low, high = np.sort(np.stack([first, neighbors[first, slot]]), axis=0)
    fraction = np.linspace(0, 1, pieces + 1)[:, None]
    places = nodes[low][:, None] + fraction * (nodes[high] - nodes[low])[:, None]
    centers, radii = sphere_places(robot, places.reshape(-1, 3))
    centers = centers.reshape(len(first), -1, 3)
    radii = np.tile(radii, pieces + 1)
    for field, price in zip(readings, prices[1], strict=True):
        least, most = plain_margins(grid, field, centers, radii)
        found = price[first, slot]
        assert (found <= softplus(least - 1e-6) * (1 + 1e-4) + 1e-6).all()
        assert (found >= softplus(most + 1e-6) * (1 - 1e-4) - 1e-6).all()
        assert (least == most).mean() > 0.95
    assert np.ptp(prices[1]) > 5


def test_a_table_has_each_cell_of_an_edge_once_with_the_largest_radius_there():
    rng = np.random.default_rng(9)
    seen, radii = rng.integers(0, 9, (40, 5, 3)), np.array([0.2, 0.1, 0.3, 0.1, 0.2])
    seen[0] = 4  # all in one cell
    keys, count = _keys(seen.astype(np.int32), radii)
    distinct = np.array([0.3, 0.2, 0.1], np.float32)
    cells, largest = keys // 3, distinct[keys % 3]
    plain = []
    for places in seen:
        best = {}
        for cell, radius in zip(places.ravel(), np.repeat(radii, 3), strict=True):
            best[cell] = max(radius, best.get(cell, 0.0))
        plain.append(sorted(best.items()))
    assert count.tolist() == list(map(len, plain))
    assert keys.shape[1] == count.max()
    for row, (found, radius) in enumerate(zip(cells, largest, strict=True)):
        repeated = [plain[row][i % len(plain[row])] for i in range(cells.shape[1])]
        assert list(zip(found, radius, strict=True)) == [(c, np.float32(r)) for c, r in repeated]


def test_tables_of_roadmaps_of_one_size_have_one_shape(robot, guide):
    shapes = set()
    for seed in range(3):
        table = guide.tabulate(stored_roadmap(robot, 38, seed))
        shapes.add(tuple(x.shape for x in table))
        # The widest block first, and no edge that no block has.
        assert (np.diff(table.width) <= 0).all()
        assert int(table.edge.max()) <= table.width.size * table.keys.shape[2]
    assert len(shapes) == 1


def test_stored_prices_do_not_depend_on_the_batch(guide, table, readings, prices):
    price, batch = prices
    for i in range(3):
        np.testing.assert_array_equal(price(guide.weights, readings[i : i + 1], table)[0], batch[i])
    turned = price(guide.weights, readings[::-1], table)
    np.testing.assert_array_equal(turned, batch[::-1])


def test_stored_prices_are_the_same_both_ways_and_never_negative(stored, prices):
    neighbors, mask = np.asarray(stored.neighbors), np.asarray(stored.neighbor_mask)
    for price in prices[1]:
        both = np.full((len(mask), len(mask)), np.nan)
        first, slot = np.nonzero(mask)
        both[first, neighbors[first, slot]] = price[first, slot]
        np.testing.assert_array_equal(both, both.T)
        assert (price >= 0).all()
        assert (price[~mask] == 0).all()


def test_a_roadmap_without_edges_has_a_table(guide, stored, readings):
    alone = stored._replace(
        neighbor_mask=jnp.zeros_like(stored.neighbor_mask),
        neighbors=jnp.broadcast_to(
            jnp.arange(len(stored.nodes), dtype=jnp.int32)[:, None], stored.neighbors.shape
        ),
    )
    assert not guide.stored(guide.weights, readings, guide.tabulate(alone)).any()


def test_prices_of_nodes_rise_as_margins_fall(robot, guide, margin, readings):
    q = random_configurations(np.random.default_rng(6), robot, 400)
    found = guide.prices(guide.weights, readings[0])
    price = np.asarray(jax.jit(found.nodes)(q))
    margins = np.asarray(margin(readings[0], q))
    order = np.argsort(margins)
    assert (np.diff(price[order]) <= 0).all()
    assert (price >= 0).all()
    np.testing.assert_allclose(price, softplus(margins), rtol=1e-4, atol=1e-6)
    assert price[order[0]] > 5 > 0.01 > price[order[-1]]


def test_the_price_of_a_motion_is_that_of_its_worst_place_in_either_direction(
    robot, guide, readings
):
    rng = np.random.default_rng(7)
    starts, ends = (random_configurations(rng, robot, 60) for _ in range(2))
    found = guide.prices(guide.weights, readings[1])
    nodes, motions = jax.jit(found.nodes), jax.jit(found.motions, static_argnums=2)
    for most in (4, 16):
        there = np.asarray(motions(starts, ends, most))
        expected = []
        for start, end in zip(starts, ends, strict=True):
            pieces = int(np.clip(np.ceil(np.linalg.norm(end - start) / SPACING), 1, most))
            # Of one length, so that it is compiled once; the end counts again.
            place = np.minimum(np.arange(most + 1, dtype=np.float32), np.float32(pieces))
            fraction = (place / np.float32(pieces))[:, None]
            expected.append(np.asarray(nodes(start + fraction * (end - start))).max())
        # A place that is on the border of two cells may be in either.
        assert (np.abs(there - expected) <= 1e-5 * np.abs(expected)).mean() > 0.95
        back = np.asarray(motions(ends, starts, most))
        assert (np.abs(there - back) <= 1e-5 * there).mean() > 0.95
    assert np.ptp(there) > 5


def test_free_edges_are_ranked_above_blocked_ones(robot, guide, stored, read, table, prices):
    check = jax.jit(make_checker(robot).check_edges)
    nodes, neighbors = np.asarray(stored.nodes), np.asarray(stored.neighbors)
    own = np.arange(len(nodes))[:, None]
    first, slot = np.nonzero(np.asarray(stored.neighbor_mask) & (own < neighbors))
    check_nodes = jax.jit(make_checker(robot).check_configurations)
    rng = np.random.default_rng(8)
    scenes = [jax.tree.map(np.asarray, random_scene(rng, 9)) for _ in range(3)]
    found = prices[0](guide.weights, jnp.stack([read(scene) for scene in scenes]), table)
    for scene, price in zip(scenes, np.asarray(found), strict=True):
        node = np.asarray(check_nodes(scene, nodes))
        second = neighbors[first, slot]
        valid = check(scene, nodes[first], nodes[second]).valid & node[first] & node[second]
        rank, num = rankdata(-price[first, slot]), int(valid.sum())
        assert 20 < num < len(valid) - 20
        below = rank[valid].sum() - num * (num + 1) / 2
        assert below / num / (len(valid) - num) > 0.95
