"""Families of a table, a wall with a window, and an open bin."""

import jax
import jax.numpy as jnp

from gnnjax.problems.structures import (
    FAR,
    MARGIN,
    THIN,
    FamilyScene,
    Placement,
    about,
    beside_arm,
    boxes_between,
    joined,
    multiply,
    region_between,
    swapped,
    to_world,
    uniform,
)
from gnnjax.scene.scene import box_scene


def draw_table(key: jax.Array) -> FamilyScene:
    """A table with 3 to 8 objects on it; the tip goes from one end to the other, among them."""
    size_key, number_key, object_key, pose_key, swap_key = jax.random.split(key, 5)
    #      gap to the arm, height, depth / 2, width / 2
    gap, height, depth, width = uniform(
        size_key, [0.15, -0.45, 0.25, 0.45], [0.30, -0.10, 0.35, 0.65]
    )
    pose = beside_arm(pose_key, gap, height)
    number = jax.random.randint(number_key, (), 3, 9)
    # Objects stand in the cells of a grid of 2 x 4, which mostly keeps them apart.
    cell = jnp.arange(8)
    middle = jnp.stack([cell % 2 * 1.0 + 0.5, cell // 2 * 0.5 - 0.75], axis=1)
    middle = middle * jnp.stack([depth, width])
    shift_key, turn_key, extent_key, rank_key = jax.random.split(object_key, 4)
    middle = middle + uniform(shift_key, [-0.03, -0.03], [0.03, 0.03], 8)
    extents = uniform(extent_key, [0.03, 0.03, 0.15], [0.08, 0.08, 0.40], 8)
    turns = jax.random.uniform(turn_key, (8,), maxval=jnp.pi)
    exists = jnp.argsort(jax.random.uniform(rank_key, (8,))) < number
    furniture = boxes_between(
        pose,
        [
            ([0, -width, -2 * THIN], [2 * depth, width, 0]),
            ([depth - 0.05, -0.05, -0.6], [depth + 0.05, 0.05, -2 * THIN]),
        ],
        jnp.ones(2, bool),
    )
    local = jnp.concatenate([middle, extents[:, 2:]], axis=1)
    objects = box_scene(
        to_world(pose, local),
        extents,
        jax.vmap(lambda turn: multiply(pose.quat, about(2, turn)))(turns),
        exists,
    )
    ends = [
        region_between(pose, [0, min(a, b) * width, 0.03], [2 * depth, max(a, b) * width, 0.15])
        for a, b in ((-0.2, -1.0), (0.2, 1.0))
    ]
    return FamilyScene(joined(furniture, objects), *swapped(swap_key, *ends))


def draw_window(key: jax.Array) -> FamilyScene:
    """A wall across the workspace with a window; one end is in front of it, one behind."""
    size_key, pose_key, swap_key = jax.random.split(key, 3)
    #     distance, window's place sideways and up, half its width and height
    distance, side, up, width, height = uniform(
        size_key, [0.30, -0.25, -0.15, 0.16, 0.16], [0.50, 0.25, 0.35, 0.28, 0.28]
    )
    pose = beside_arm(pose_key, distance, 0.0, tilt=0.12)
    left, right, bottom, top = side - width, side + width, up - height, up + height
    walls = [
        ([0, -1, -1], [2 * THIN, left, 1]),
        ([0, right, -1], [2 * THIN, 1, 1]),
        ([0, left, -1], [2 * THIN, right, bottom]),
        ([0, left, top], [2 * THIN, right, 1]),
    ]
    front = region_between(pose, [-FAR, -FAR, -FAR], [-MARGIN, FAR, FAR])
    behind = region_between(pose, [2 * THIN + MARGIN, -1, -1], [FAR, 1, 1])
    scene = joined(boxes_between(pose, walls, jnp.ones(4, bool)))
    return FamilyScene(scene, *swapped(swap_key, front, behind))


def draw_bin(key: jax.Array) -> FamilyScene:
    """An open bin; the tip is inside it at one end, and outside at the other."""
    size_key, turn_key, pose_key, swap_key = jax.random.split(key, 4)
    #      distance, height of the bottom, half of both widths, height
    distance, bottom, length, width, height = uniform(
        size_key, [0.45, -0.55, 0.13, 0.13, 0.30], [0.65, -0.20, 0.25, 0.25, 0.50]
    )
    pose = beside_arm(pose_key, distance, bottom, tilt=0.1)
    turn = jax.random.uniform(turn_key, (), maxval=jnp.pi)
    bin_pose = Placement(pose.position, multiply(pose.quat, about(2, turn)))
    walls = [
        ([-length, -width, -2 * THIN], [length, width, 0]),
        *(([s * length - THIN, -width, 0], [s * length + THIN, width, height]) for s in (-1, 1)),
        *(([-length, s * width - THIN, 0], [length, s * width + THIN, height]) for s in (-1, 1)),
    ]
    inside = region_between(
        bin_pose,
        [MARGIN - length, MARGIN - width, MARGIN],
        [length - MARGIN, width - MARGIN, 0.6 * height],
    )
    # Beside the bin and below its rim, so that the arm has to lift the tip over the wall.
    outside = region_between(pose, [-0.3, 0.4, -FAR], [FAR, FAR, 0.8 * height])
    scene = joined(boxes_between(bin_pose, walls, jnp.ones(5, bool)))
    return FamilyScene(scene, *swapped(swap_key, inside, outside))
