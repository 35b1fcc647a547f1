"""Families of shelves: boards between which the tip goes from one place to another."""

import jax
import jax.numpy as jnp

from gnnjax.problems.camera import look_at
from gnnjax.problems.structures import (
    FAR,
    MARGIN,
    THIN,
    FamilyScene,
    Region,
    beside_arm,
    boxes_between,
    choose,
    cylinders,
    joined,
    region_between,
    swapped,
    uniform,
    unit,
)

_TILT = 0.2  # rad, at which a bottle that is not full spills nothing


def draw_shelf(key: jax.Array) -> FamilyScene:
    """An upright shelf of 2 to 6 compartments; the tip goes from one to another, or comes out."""
    keys = jax.random.split(key, 6)
    size_key, count_key, board_key, divider_key, cell_key, pose_key = keys
    #            distance, height of the bottom, width / 2, height, depth
    distance, bottom, width, height, depth = uniform(
        size_key, [0.45, -0.60, 0.40, 1.05, 0.20], [0.65, -0.40, 0.60, 1.35, 0.32]
    )
    rows, columns = jax.random.randint(count_key, (2,), jnp.array([2, 1]), jnp.array([5, 3]))
    columns = jnp.where(rows == 4, 1, columns)  # small compartments leave no way in
    # Boards: where they split the height evenly, and off that by up to a sixth of their distance.
    place = jnp.arange(5) + jnp.pad(jax.random.uniform(board_key, (3,), minval=-1) / 6, (1, 1))
    boards = height * jnp.where(jnp.arange(5) < rows, place / rows, 1.0)
    divider = width * uniform(divider_key, [-0.2], [0.2])[0]
    low_high = [
        ([depth, -width, 0], [depth + 2 * THIN, width, height]),
        *(([0, s * width - THIN, 0], [depth, s * width + THIN, height]) for s in (-1, 1)),
        *(([0, -width, z - THIN], [depth, width, z + THIN]) for z in boards),
        ([0, divider - THIN, 0], [depth, divider + THIN, height]),
    ]
    exists = [jnp.ones(3, bool), jnp.arange(5) <= rows, (columns == 2)[None]]
    pose = beside_arm(pose_key, distance, bottom)

    def compartment(cell: jax.Array) -> Region:
        row, column = cell // columns, cell % columns
        left = jnp.where(column == 1, divider, -width)
        right = jnp.where((columns == 2) & (column == 0), divider, width)
        return region_between(
            pose,
            [0.2 * depth, left + MARGIN, boards[row] + MARGIN],
            [0.85 * depth, right - MARGIN, boards[row + 1] - MARGIN],
        )

    order_key, outside_key, swap_key = jax.random.split(cell_key, 3)
    # Two different compartments: the first two of those that exist in a random order.
    rank = jnp.where(jnp.arange(6) < rows * columns, jax.random.uniform(order_key, (6,)), 2.0)
    first, second = jnp.argsort(rank)[:2]
    outside = region_between(pose, [-FAR, -FAR, -FAR], [-0.1, FAR, FAR])
    ends_outside = jax.random.bernoulli(outside_key, 0.4)
    goal = choose(ends_outside, outside, compartment(second))
    scene = joined(boxes_between(pose, low_high, jnp.concatenate(exists)))
    return FamilyScene(scene, *swapped(swap_key, compartment(first), goal))


def draw_cans(key: jax.Array) -> FamilyScene:
    """A shelf of 2 or 3 boards with cans and bottles on them; the tip goes from one gap among them
    to another, or comes out."""
    keys = jax.random.split(key, 7)
    size_key, count_key, can_key, shift_key, cell_key, pose_key, end_key = keys
    #            distance, height of the bottom, width / 2, height, depth
    distance, bottom, width, height, depth = uniform(
        size_key, [0.45, -0.55, 0.45, 1.05, 0.24], [0.60, -0.40, 0.60, 1.25, 0.34]
    )
    rows = jax.random.randint(count_key, (), 2, 4)
    boards = height * jnp.minimum(jnp.arange(4) / rows, 1.0)
    low_high = [
        ([depth, -width, 0], [depth + 2 * THIN, width, height]),
        *(([0, s * width - THIN, 0], [depth, s * width + THIN, height]) for s in (-1, 1)),
        *(([0, -width, z - THIN], [depth, width, z + THIN]) for z in boards),
    ]
    pose = beside_arm(pose_key, distance, bottom)
    furniture = boxes_between(
        pose, low_high, jnp.concatenate([jnp.ones(3, bool), jnp.arange(4) <= rows])
    )
    # What stands on a board stands in one of 4 cells. Two cells are left empty for the tip, and so
    # are some others.
    cell = jnp.arange(12)
    row, column = cell // 4, cell % 4
    on_board = row < rows
    order_key, some_key = jax.random.split(cell_key)
    order = jnp.argsort(jnp.where(on_board, jax.random.uniform(order_key, (12,)), 2.0))
    first, second = order[:2]
    exists = on_board & (cell != first) & (cell != second)
    exists &= jax.random.bernoulli(some_key, 0.75, (12,))
    shift = uniform(shift_key, [0.3, -0.15], [0.7, 0.15], 12)
    at = jnp.stack(
        [depth * shift[:, 0], width * ((column + 0.5 + shift[:, 1]) / 2 - 1), boards[row] + THIN],
        axis=1,
    )
    kind_key, body_key = jax.random.split(can_key)
    is_bottle = jax.random.bernoulli(kind_key, 0.5, (12,))
    #    radius and half height of a can, of a bottle's body, of its neck
    size = uniform(
        body_key, [0.03, 0.04, 0.03, 0.07, 0.010, 0.03], [0.05, 0.08, 0.05, 0.12, 0.015, 0.05], 12
    )
    radius = jnp.where(is_bottle, size[:, 2], size[:, 0])
    half = jnp.where(is_bottle, size[:, 3], size[:, 1])
    up = jnp.array([0.0, 0.0, 1.0])
    bodies = cylinders(pose, at + half[:, None] * up, radius, half, exists)
    above = at + (2 * half + size[:, 5])[:, None] * up
    necks = cylinders(pose, above, size[:, 4], size[:, 5], exists & is_bottle)

    def gap(cell: jax.Array) -> Region:
        left = width * (cell % 4 / 2 - 1)
        board = boards[cell // 4]
        return region_between(
            pose,
            [0.15 * depth, left + 0.02, board + MARGIN],
            [0.85 * depth, left + width / 2 - 0.02, jnp.minimum(board + 0.25, height - MARGIN)],
        )

    outside_key, swap_key = jax.random.split(end_key)
    outside = region_between(pose, [-FAR, -FAR, -FAR], [-0.1, FAR, FAR])
    goal = choose(jax.random.bernoulli(outside_key, 0.3), outside, gap(second))
    return FamilyScene(joined(furniture, bodies, necks), *swapped(swap_key, gap(first), goal))


def draw_upright(key: jax.Array) -> FamilyScene:
    """The shelf, for an arm that holds a bottle, which is upright at start and goal.

    On the way it may tilt: paths have no constraints here.
    """
    return draw_shelf(key)._replace(tilt=jnp.float32(_TILT))


def draw_cloud_shelf(key: jax.Array) -> FamilyScene:
    """The shelf, as a depth camera above the arm sees it, from one side or the other."""
    shelf_key, side_key, place_key = jax.random.split(key, 3)
    drawn = draw_shelf(shelf_key)
    scene = drawn.scene
    middle = jnp.mean(scene.centers, axis=0, where=scene.mask[:, None])
    away = unit(middle[:2])
    side = jnp.where(jax.random.bernoulli(side_key), 1.0, -1.0)
    beside = side * jnp.stack([-away[1], away[0]])
    #  behind the arm, beside it, and above its middle
    behind, aside, above = uniform(place_key, [0.1, 0.3, 0.5], [0.3, 0.6, 0.8])
    camera = jnp.append(aside * beside - behind * away, above)
    seen = look_at(scene, camera, middle)
    return drawn._replace(scene=scene._replace(mask=jnp.zeros_like(scene.mask)), seen=seen)
