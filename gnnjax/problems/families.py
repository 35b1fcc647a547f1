"""Families of scenes that are hard on purpose: shelf, table, window, clutter, bin, cans, pipes, and
a shelf as a depth camera sees it.

A family draws a scene and the two regions in which the arm's tip starts and ends. All lengths here
are in units of the arm's reach, and the origin is the middle of its workspace, so that a family
makes sense for an arm of any size; z points up. A structure is drawn in a frame of its own, whose x
axis points away from the arm, and then put somewhere around it.

Longer than other modules, since a family is a page and they share their words.
"""

from typing import Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gnnjax.problems.camera import look_at
from gnnjax.scene.scene import Scene, box_bucket, box_scene, rotation_matrices

FamilyName: TypeAlias = Literal[
    "shelf", "table", "window", "clutter", "bin", "cans", "pipes", "cloud_shelf"
]

_THIN = 0.012  # half the thickness of walls and boards
_FAR = 2.0  # beyond all that the arm reaches
_MARGIN = 0.04  # of the tip to walls; most arms are thicker than that


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


class _Pose(NamedTuple):
    position: Float[Array, "3"]
    quat: Float[Array, "4"]


def draw_shelf(key: jax.Array) -> FamilyScene:
    """An upright shelf of 2 to 6 compartments; the tip goes from one to another, or comes out."""
    keys = jax.random.split(key, 6)
    size_key, count_key, board_key, divider_key, cell_key, pose_key = keys
    #            distance, height of the bottom, width / 2, height, depth
    distance, bottom, width, height, depth = _uniform(
        size_key, [0.45, -0.60, 0.40, 1.05, 0.20], [0.65, -0.40, 0.60, 1.35, 0.32]
    )
    rows, columns = jax.random.randint(count_key, (2,), jnp.array([2, 1]), jnp.array([5, 3]))
    columns = jnp.where(rows == 4, 1, columns)  # small compartments leave no way in
    # Boards: where they split the height evenly, and off that by up to a sixth of their distance.
    place = jnp.arange(5) + jnp.pad(jax.random.uniform(board_key, (3,), minval=-1) / 6, (1, 1))
    boards = height * jnp.where(jnp.arange(5) < rows, place / rows, 1.0)
    divider = width * _uniform(divider_key, [-0.2], [0.2])[0]
    low_high = [
        ([depth, -width, 0], [depth + 2 * _THIN, width, height]),
        *(([0, s * width - _THIN, 0], [depth, s * width + _THIN, height]) for s in (-1, 1)),
        *(([0, -width, z - _THIN], [depth, width, z + _THIN]) for z in boards),
        ([0, divider - _THIN, 0], [depth, divider + _THIN, height]),
    ]
    exists = [jnp.ones(3, bool), jnp.arange(5) <= rows, (columns == 2)[None]]
    pose = _beside_arm(pose_key, distance, bottom)

    def compartment(cell: jax.Array) -> Region:
        row, column = cell // columns, cell % columns
        left = jnp.where(column == 1, divider, -width)
        right = jnp.where((columns == 2) & (column == 0), divider, width)
        return _region(
            pose,
            [0.2 * depth, left + _MARGIN, boards[row] + _MARGIN],
            [0.85 * depth, right - _MARGIN, boards[row + 1] - _MARGIN],
        )

    order_key, outside_key, swap_key = jax.random.split(cell_key, 3)
    # Two different compartments: the first two of those that exist in a random order.
    rank = jnp.where(jnp.arange(6) < rows * columns, jax.random.uniform(order_key, (6,)), 2.0)
    first, second = jnp.argsort(rank)[:2]
    outside = _region(pose, [-_FAR, -_FAR, -_FAR], [-0.1, _FAR, _FAR])
    ends_outside = jax.random.bernoulli(outside_key, 0.4)
    goal = _choose(ends_outside, outside, compartment(second))
    scene = _padded(_placed(pose, low_high, jnp.concatenate(exists)))
    return FamilyScene(scene, *_swapped(swap_key, compartment(first), goal))


def draw_table(key: jax.Array) -> FamilyScene:
    """A table with 3 to 8 objects on it; the tip goes from one end to the other, among them."""
    size_key, number_key, object_key, pose_key, swap_key = jax.random.split(key, 5)
    #      gap to the arm, height, depth / 2, width / 2
    gap, height, depth, width = _uniform(
        size_key, [0.15, -0.45, 0.25, 0.45], [0.30, -0.10, 0.35, 0.65]
    )
    pose = _beside_arm(pose_key, gap, height)
    number = jax.random.randint(number_key, (), 3, 9)
    # Objects stand in the cells of a grid of 2 x 4, which mostly keeps them apart.
    cell = jnp.arange(8)
    middle = jnp.stack([cell % 2 * 1.0 + 0.5, cell // 2 * 0.5 - 0.75], axis=1)
    middle = middle * jnp.stack([depth, width])
    shift_key, turn_key, extent_key, rank_key = jax.random.split(object_key, 4)
    middle = middle + _uniform(shift_key, [-0.03, -0.03], [0.03, 0.03], 8)
    extents = _uniform(extent_key, [0.03, 0.03, 0.15], [0.08, 0.08, 0.40], 8)
    turns = jax.random.uniform(turn_key, (8,), maxval=jnp.pi)
    exists = jnp.argsort(jax.random.uniform(rank_key, (8,))) < number
    furniture = _placed(
        pose,
        [
            ([0, -width, -2 * _THIN], [2 * depth, width, 0]),
            ([depth - 0.05, -0.05, -0.6], [depth + 0.05, 0.05, -2 * _THIN]),
        ],
        jnp.ones(2, bool),
    )
    local = jnp.concatenate([middle, extents[:, 2:]], axis=1)
    objects = box_scene(
        _to_world(pose, local),
        extents,
        jax.vmap(lambda turn: _multiply(pose.quat, _about(2, turn)))(turns),
        exists,
    )
    ends = [
        _region(pose, [0, min(a, b) * width, 0.03], [2 * depth, max(a, b) * width, 0.15])
        for a, b in ((-0.2, -1.0), (0.2, 1.0))
    ]
    return FamilyScene(_padded(furniture, objects), *_swapped(swap_key, *ends))


def draw_window(key: jax.Array) -> FamilyScene:
    """A wall across the workspace with a window; one end is in front of it, one behind."""
    size_key, pose_key, swap_key = jax.random.split(key, 3)
    #     distance, window's place sideways and up, half its width and height
    distance, side, up, width, height = _uniform(
        size_key, [0.30, -0.25, -0.15, 0.16, 0.16], [0.50, 0.25, 0.35, 0.28, 0.28]
    )
    pose = _beside_arm(pose_key, distance, 0.0, tilt=0.12)
    left, right, bottom, top = side - width, side + width, up - height, up + height
    walls = [
        ([0, -1, -1], [2 * _THIN, left, 1]),
        ([0, right, -1], [2 * _THIN, 1, 1]),
        ([0, left, -1], [2 * _THIN, right, bottom]),
        ([0, left, top], [2 * _THIN, right, 1]),
    ]
    front = _region(pose, [-_FAR, -_FAR, -_FAR], [-_MARGIN, _FAR, _FAR])
    behind = _region(pose, [2 * _THIN + _MARGIN, -1, -1], [_FAR, 1, 1])
    scene = _padded(_placed(pose, walls, jnp.ones(4, bool)))
    return FamilyScene(scene, *_swapped(swap_key, front, behind))


def draw_clutter(key: jax.Array) -> FamilyScene:
    """10 to 20 blocks, thin pillars and plates, turned anyhow, all around the arm."""
    number_key, kind_key, size_key, place_key, far_key, turn_key = jax.random.split(key, 6)
    num = 20
    kind = jax.random.randint(kind_key, (num,), 0, 3)  # block, pillar, plate
    low = jnp.array([[0.03, 0.03, 0.03], [0.01, 0.01, 0.15], [0.01, 0.08, 0.08]])
    high = jnp.array([[0.10, 0.10, 0.10], [0.03, 0.03, 0.45], [0.015, 0.22, 0.22]])
    half_extents = jax.random.uniform(size_key, (num, 3), minval=low[kind], maxval=high[kind])
    direction = _unit(jax.random.normal(place_key, (num, 3)))
    distance = jax.random.uniform(far_key, (num, 1), minval=0.35, maxval=0.85)
    quats = _unit(jax.random.normal(turn_key, (num, 4)))
    exists = jnp.arange(num) < jax.random.randint(number_key, (), 10, num + 1)
    anywhere = Region(jnp.zeros(3), jnp.full(3, _FAR), _about(2, jnp.zeros(())))
    scene = box_scene(distance * direction, half_extents, quats, exists)
    return FamilyScene(_padded(scene), anywhere, anywhere)


def draw_bin(key: jax.Array) -> FamilyScene:
    """An open bin; the tip is inside it at one end, and outside at the other."""
    size_key, turn_key, pose_key, swap_key = jax.random.split(key, 4)
    #      distance, height of the bottom, half of both widths, height
    distance, bottom, length, width, height = _uniform(
        size_key, [0.45, -0.55, 0.13, 0.13, 0.30], [0.65, -0.20, 0.25, 0.25, 0.50]
    )
    pose = _beside_arm(pose_key, distance, bottom, tilt=0.1)
    turn = jax.random.uniform(turn_key, (), maxval=jnp.pi)
    bin_pose = _Pose(pose.position, _multiply(pose.quat, _about(2, turn)))
    walls = [
        ([-length, -width, -2 * _THIN], [length, width, 0]),
        *(([s * length - _THIN, -width, 0], [s * length + _THIN, width, height]) for s in (-1, 1)),
        *(([-length, s * width - _THIN, 0], [length, s * width + _THIN, height]) for s in (-1, 1)),
    ]
    inside = _region(
        bin_pose,
        [_MARGIN - length, _MARGIN - width, _MARGIN],
        [length - _MARGIN, width - _MARGIN, 0.6 * height],
    )
    # Beside the bin and below its rim, so that the arm has to lift the tip over the wall.
    outside = _region(pose, [-0.3, 0.4, -_FAR], [_FAR, _FAR, 0.8 * height])
    scene = _padded(_placed(bin_pose, walls, jnp.ones(5, bool)))
    return FamilyScene(scene, *_swapped(swap_key, inside, outside))


def draw_cans(key: jax.Array) -> FamilyScene:
    """A shelf of 2 or 3 boards with cans and bottles on them; the tip goes from one gap among them
    to another, or comes out."""
    keys = jax.random.split(key, 7)
    size_key, count_key, can_key, shift_key, cell_key, pose_key, end_key = keys
    #            distance, height of the bottom, width / 2, height, depth
    distance, bottom, width, height, depth = _uniform(
        size_key, [0.45, -0.55, 0.45, 1.05, 0.24], [0.60, -0.40, 0.60, 1.25, 0.34]
    )
    rows = jax.random.randint(count_key, (), 2, 4)
    boards = height * jnp.minimum(jnp.arange(4) / rows, 1.0)
    low_high = [
        ([depth, -width, 0], [depth + 2 * _THIN, width, height]),
        *(([0, s * width - _THIN, 0], [depth, s * width + _THIN, height]) for s in (-1, 1)),
        *(([0, -width, z - _THIN], [depth, width, z + _THIN]) for z in boards),
    ]
    pose = _beside_arm(pose_key, distance, bottom)
    furniture = _placed(pose, low_high, jnp.concatenate([jnp.ones(3, bool), jnp.arange(4) <= rows]))
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
    shift = _uniform(shift_key, [0.3, -0.15], [0.7, 0.15], 12)
    at = jnp.stack(
        [depth * shift[:, 0], width * ((column + 0.5 + shift[:, 1]) / 2 - 1), boards[row] + _THIN],
        axis=1,
    )
    kind_key, body_key = jax.random.split(can_key)
    is_bottle = jax.random.bernoulli(kind_key, 0.5, (12,))
    #    radius and half height of a can, of a bottle's body, of its neck
    size = _uniform(
        body_key, [0.03, 0.04, 0.03, 0.07, 0.010, 0.03], [0.05, 0.08, 0.05, 0.12, 0.015, 0.05], 12
    )
    radius = jnp.where(is_bottle, size[:, 2], size[:, 0])
    half = jnp.where(is_bottle, size[:, 3], size[:, 1])
    up = jnp.array([0.0, 0.0, 1.0])
    bodies = _upright(pose, at + half[:, None] * up, radius, half, exists)
    above = at + (2 * half + size[:, 5])[:, None] * up
    necks = _upright(pose, above, size[:, 4], size[:, 5], exists & is_bottle)

    def gap(cell: jax.Array) -> Region:
        left = width * (cell % 4 / 2 - 1)
        board = boards[cell // 4]
        return _region(
            pose,
            [0.15 * depth, left + 0.02, board + _MARGIN],
            [0.85 * depth, left + width / 2 - 0.02, jnp.minimum(board + 0.25, height - _MARGIN)],
        )

    outside_key, swap_key = jax.random.split(end_key)
    outside = _region(pose, [-_FAR, -_FAR, -_FAR], [-0.1, _FAR, _FAR])
    goal = _choose(jax.random.bernoulli(outside_key, 0.3), outside, gap(second))
    return FamilyScene(_padded(furniture, bodies, necks), *_swapped(swap_key, gap(first), goal))


def draw_pipes(key: jax.Array) -> FamilyScene:
    """8 to 14 pipes, half of them with round ends, that cross the workspace beside the arm."""
    keys = jax.random.split(key, 6)
    number_key, kind_key, size_key, place_key, far_key, axis_key = keys
    num = 14
    direction = _unit(jax.random.normal(place_key, (num, 3)))
    # Across the way from the arm, so that none leads into its base.
    axis = jax.random.normal(axis_key, (num, 3))
    axis = _unit(axis - jnp.sum(axis * direction, axis=1, keepdims=True) * direction)
    distance = jax.random.uniform(far_key, (num, 1), minval=0.35, maxval=0.9)
    radius, half = _uniform(size_key, [0.015, 0.5], [0.06, 1.2], num).T
    is_capsule = jax.random.bernoulli(kind_key, 0.5, (num,))
    exists = jnp.arange(num) < jax.random.randint(number_key, (), 8, num + 1)
    # The shortest rotation of z to the axis; opposite to z, that is never drawn, it has none.
    quats = _unit(jnp.stack([1 + axis[:, 2], -axis[:, 1], axis[:, 0], 0 * radius], axis=1))
    anywhere = Region(jnp.zeros(3), jnp.full(3, _FAR), _about(2, jnp.zeros(())))
    scene = _round(distance * direction, radius, half, quats, is_capsule, exists)
    return FamilyScene(_padded(scene), anywhere, anywhere)


def draw_cloud_shelf(key: jax.Array) -> FamilyScene:
    """The shelf, as a depth camera above the arm sees it, from one side or the other."""
    shelf_key, side_key, place_key = jax.random.split(key, 3)
    drawn = draw_shelf(shelf_key)
    scene = drawn.scene
    middle = jnp.mean(scene.centers, axis=0, where=scene.mask[:, None])
    away = _unit(middle[:2])
    side = jnp.where(jax.random.bernoulli(side_key), 1.0, -1.0)
    beside = side * jnp.stack([-away[1], away[0]])
    #  behind the arm, beside it, and above its middle
    behind, aside, above = _uniform(place_key, [0.1, 0.3, 0.5], [0.3, 0.6, 0.8])
    camera = jnp.append(aside * beside - behind * away, above)
    seen = look_at(scene, camera, middle)
    return drawn._replace(scene=scene._replace(mask=jnp.zeros_like(scene.mask)), seen=seen)


FAMILIES = {
    "shelf": draw_shelf,
    "table": draw_table,
    "window": draw_window,
    "clutter": draw_clutter,
    "bin": draw_bin,
    # Problems are drawn by the number of their family: others go to the end.
    "cans": draw_cans,
    "pipes": draw_pipes,
    "cloud_shelf": draw_cloud_shelf,
}
BOX_FAMILIES = ("shelf", "table", "window", "clutter", "bin")  # what the motion network learns from


def _uniform(key: jax.Array, low: list, high: list, *shape: int) -> jax.Array:
    bounds = jnp.array(low), jnp.array(high)
    return jax.random.uniform(key, (*shape, len(low)), minval=bounds[0], maxval=bounds[1])


def _beside_arm(
    key: jax.Array, distance: jax.Array, height: jax.Array | float, *, tilt: float = 0.0
) -> _Pose:
    """A frame somewhere around the arm, whose x axis points away from it give or take 0.3 rad."""
    around_key, swing_key, tilt_key = jax.random.split(key, 3)
    around = jax.random.uniform(around_key, (), minval=-jnp.pi, maxval=jnp.pi)
    swing = jax.random.uniform(swing_key, (), minval=-0.3, maxval=0.3)
    roll, pitch = jax.random.uniform(tilt_key, (2,), minval=-tilt, maxval=tilt)
    position = jnp.stack([distance * jnp.cos(around), distance * jnp.sin(around), height + 0.0])
    lean = _multiply(_about(0, roll), _about(1, pitch))
    return _Pose(position, _multiply(_about(2, around + swing), lean))


def _about(axis: int, angle: jax.Array) -> jax.Array:
    """The quaternion of a turn about a coordinate axis."""
    return jnp.zeros(4).at[0].set(jnp.cos(angle / 2)).at[axis + 1].set(jnp.sin(angle / 2))


def _unit(vectors: jax.Array) -> jax.Array:
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def _multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """The quaternion of turn b followed by turn a."""
    vector = a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])
    return jnp.concatenate([(a[0] * b[0] - a[1:] @ b[1:])[None], vector])


def _to_world(pose: _Pose, points: jax.Array) -> jax.Array:
    return pose.position + points @ rotation_matrices(pose.quat).T


def _corners(low: list, high: list) -> tuple[jax.Array, jax.Array]:
    first, last = (jnp.stack([jnp.asarray(x, jnp.float32) for x in end]) for end in (low, high))
    return (first + last) / 2, (last - first) / 2


def _region(pose: _Pose, low: list, high: list) -> Region:
    """The region between two corners in a structure's frame."""
    center, half_extents = _corners(low, high)
    return Region(_to_world(pose, center), half_extents, pose.quat)


def _placed(pose: _Pose, low_high: list, exists: Bool[Array, " M"]) -> Scene:
    """Boxes between pairs of corners in a structure's frame."""
    parts = [_corners(low, high) for low, high in low_high]
    centers, half_extents = (jnp.stack(part) for part in zip(*parts, strict=True))
    quats = jnp.tile(pose.quat, (len(parts), 1))
    return box_scene(_to_world(pose, centers), half_extents, quats, exists)


def _upright(
    pose: _Pose, centers: jax.Array, radius: jax.Array, half: jax.Array, exists: jax.Array
) -> Scene:
    """Cylinders along the z axis of a structure's frame."""
    quats = jnp.tile(pose.quat, (len(centers), 1))
    return _round(_to_world(pose, centers), radius, half, quats, jnp.zeros_like(exists), exists)


def _round(
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


def _padded(*scenes: Scene) -> Scene:
    """Joins scenes, and pads them to a box bucket."""
    joined = jax.tree.map(lambda *x: jnp.concatenate(x), *scenes)
    missing = box_bucket(len(joined.mask)) - len(joined.mask)
    blank = box_scene(
        jnp.zeros((missing, 3)),
        jnp.full((missing, 3), 0.1),
        jnp.tile(_about(2, jnp.zeros(())), (missing, 1)),
        jnp.zeros(missing, bool),
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), joined, blank)


def _choose(first: jax.Array, a: Region, b: Region) -> Region:
    return jax.tree.map(lambda x, y: jnp.where(first, x, y), a, b)


def _swapped(key: jax.Array, a: Region, b: Region) -> tuple[Region, Region]:
    """Start and goal in either order."""
    first = jax.random.bernoulli(key)
    return _choose(first, a, b), _choose(first, b, a)
