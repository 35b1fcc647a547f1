"""Validity of configurations and edges: fused kernels, and the same through MJX.

A `Checker` is three pure functions for one scene; `vmap` them over scenes. The fused backend
generates straight-line code from the robot's constants (see `kinematics.py`); the MJX backend runs
MuJoCo's own collision functions and is what the fused one is compared with.

Geoms that no joint moves (an arm's base) are not tested against boxes: no configuration changes
the outcome. `boxes_clear` tests them, once a scene.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gnnjax.arm.kinematics import (
    WORLD,
    Frame,
    Joints,
    Vector,
    body_frames,
    dot,
    joint_terms,
    subtract,
    transform,
)
from gnnjax.arm.robot import CAPSULE, Robot, require_round_geoms
from gnnjax.collision.geometry import segment_box_squared, segment_segment_squared
from gnnjax.errors import InputError
from gnnjax.scene.scene import Scene, rotation_matrices

Backend: TypeAlias = Literal["fused", "mjx"]

EDGE_RESOLUTION = 0.05  # rad (or m) between neighbouring configurations tested along an edge

# Geometry pairs in one pass of the fused kernel. The compiler turns a pass into a single loop over
# the batch. It splits what exceeds 2,000 operations into functions, and where it fails to join them
# again, the loop runs several times slower.
_BOX_PAIRS_A_PASS = 250
_SELF_PAIRS_A_PASS = 600
_FAR = 1e6  # m; where padding boxes are
_MOST_INTERVALS = 20_000  # of an edge; its table of points has the square of them, 2 bytes each


class EdgeChecks(NamedTuple):
    """What testing edges found out."""

    valid: Bool[Array, "*batch"]  # every tested configuration is valid
    # Configurations a sequential test would have tested, up to and including the first that is
    # not valid. The batched test computes up to a block more.
    num_checks: Int[Array, "*batch"]


class Checker(NamedTuple):
    """The collision functions of one robot.

    `clearance(scene, q [*batch D]) -> [*batch]` m, positive when clear of boxes and itself.
    `check_configurations(scene, nodes [B D]) -> [B]`, true where valid.
    `check_edges(scene, starts [E D], ends [E D]) -> EdgeChecks [E]`; tests the configurations
    between the ends, which the caller has tested as nodes.
    """

    clearance: Callable[[Scene, jax.Array], jax.Array]
    check_configurations: Callable[[Scene, jax.Array], jax.Array]
    check_edges: Callable[[Scene, jax.Array, jax.Array], EdgeChecks]


def make_checker(
    robot: Robot,
    backend: Backend = "fused",
    *,
    axis_aligned: bool = False,
    resolution: float = EDGE_RESOLUTION,
) -> Checker:
    """Builds the collision functions of a robot.

    Args:
        robot: the arm.
        backend: "fused" (fast; spheres and capsules) or "mjx" (any geoms that MJX collides).
        axis_aligned: promise that no box is rotated; the fused kernel then skips the rotation.
        resolution: largest distance of neighbouring configurations along an edge.

    Raises:
        InputError: geom types that the backend cannot handle, an unknown backend, or a resolution
            too fine for the arm's joint ranges.
    """
    if backend == "fused":
        clearance, collision_free = _fused(robot, axis_aligned)
    elif backend == "mjx":
        from gnnjax.collision.mjx import mjx_functions

        clearance, collision_free = mjx_functions(robot)
    else:
        raise InputError(f"no collision backend {backend!r}; there are 'fused' and 'mjx'")
    lower, upper = robot.joint_lower, robot.joint_upper

    def check_configurations(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        # NaN fails these comparisons, so that it can never count as valid.
        inside = jnp.all((nodes >= lower) & (nodes <= upper), axis=-1)
        return inside & collision_free(scene, nodes)

    most_intervals = int(np.ceil(np.linalg.norm(robot.joint_range) / resolution)) + 1
    if most_intervals > _MOST_INTERVALS:
        raise InputError(
            f"resolution is {resolution}, which cuts the longest edge of {robot.name} into "
            f"{most_intervals} pieces; at most {_MOST_INTERVALS} are supported, choose a larger one"
        )
    order = bisection_order(most_intervals)

    def check_edges(
        scene: Scene, starts: Float[Array, "E D"], ends: Float[Array, "E D"]
    ) -> EdgeChecks:
        return _check_edges(check_configurations, order, resolution, scene, starts, ends)

    return Checker(clearance, check_configurations, check_edges)


def bisection_order(max_intervals: int) -> np.ndarray:
    """The order in which the points of an edge are tested: middle first, then quarters, ...

    A collision along an edge mostly covers a stretch of it; halving finds a stretch of length s in
    about 1/s tests wherever it lies.

    Returns:
        `[max_intervals + 1, max_intervals]` array; row n lists the interior points 1..n-1 of an
        edge cut into n intervals, then zeros.
    """
    order = np.zeros((max_intervals + 1, max_intervals), np.int16)
    for n in range(2, max_intervals + 1):
        row, level = [], [(0, n)]
        while level:
            deeper = []
            for low, high in level:
                middle = (low + high) // 2
                if middle > low:
                    row.append(middle)
                    deeper += [(low, middle), (middle, high)]
            level = deeper
        order[n, : n - 1] = row
    return order


def _check_edges(
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    order: np.ndarray,
    resolution: float,
    scene: Scene,
    starts: jax.Array,
    ends: jax.Array,
) -> EdgeChecks:
    num_edges, num_dof = starts.shape
    # Large batches stop early edge by edge; a lone edge is tested in one or two blocks.
    block = max(8, min(64, 512 // max(num_edges, 1)))
    # Both directions of an edge test the very same floats, so that validity cannot depend on the
    # direction: the lexicographically smaller end comes first.
    differs = starts != ends
    first = jnp.argmax(differs, axis=-1)[:, None]
    swap = jnp.take_along_axis(starts > ends, first, axis=-1)
    low, high = jnp.where(swap, ends, starts), jnp.where(swap, starts, ends)
    length = jnp.linalg.norm(high - low, axis=-1)
    max_intervals = len(order) - 1
    intervals = jnp.clip(jnp.ceil(length / resolution), 1, max_intervals).astype(jnp.int32)
    # NaN or a length beyond the robot's range: cannot be tested at the resolution, so not valid.
    testable = length <= resolution * max_intervals
    table = jnp.asarray(order)

    def unfinished(state):
        done, valid, _ = state
        return jnp.any(valid & (done < intervals - 1))

    def test_block(state):
        done, valid, num_checks = state
        step = done + jnp.arange(block)  # [block]
        wanted = step < (intervals - 1)[:, None]  # [E block]
        point = table[intervals[:, None], jnp.minimum(step, max_intervals - 1)]
        fraction = point / intervals[:, None].astype(starts.dtype)
        q = low[:, None] + fraction[..., None] * (high - low)[:, None]
        free = check_configurations(scene, q.reshape(-1, num_dof)).reshape(num_edges, block)
        hit = wanted & ~free
        refuted = jnp.any(hit, axis=-1)
        tested = jnp.where(refuted, jnp.argmax(hit, axis=-1) + 1, wanted.sum(axis=-1))
        return done + block, valid & ~refuted, num_checks + jnp.where(valid, tested, 0)

    zeros = jnp.zeros(num_edges, jnp.int32)
    _, valid, num_checks = jax.lax.while_loop(
        unfinished, test_block, (jnp.int32(0), testable, zeros)
    )
    return EdgeChecks(valid, num_checks)


def boxes_clear(
    robot: Robot, scene: Scene, q: Float[Array, " D"], *, base_only: bool = False
) -> Bool[Array, " M"]:
    """Tells for every box of a scene whether the arm is clear of it; true on padding.

    Args:
        robot: the arm.
        scene: M boxes.
        q: the arm's configuration.
        base_only: test only the geoms that no joint moves, which `Checker` leaves out.

    Raises:
        InputError: the arm has geoms other than spheres and capsules.
    """
    require_round_geoms(robot)
    moved = moved_by_joint(robot)
    chosen = [g for g in range(len(moved)) if not (base_only and moved[g])]
    if not chosen:
        return jnp.ones(scene.mask.shape, bool)
    segments = _segments(robot, joint_terms(robot, q))

    def column(part: int) -> Vector:
        points = [segments[g][part] or [0.0, 0.0, 0.0] for g in chosen]
        return [jnp.stack([jnp.asarray(p[a], q.dtype) for p in points])[:, None] for a in range(3)]

    def seen_from_box(vector: Vector) -> Vector:
        return [dot(list(to_box), vector) for to_box in to_boxes]

    to_boxes = jnp.moveaxis(rotation_matrices(scene.quats), 0, -1).swapaxes(0, 1)
    offset = seen_from_box(subtract(column(0), list(scene.centers.T)))
    axis = seen_from_box(column(1)) if CAPSULE in robot.geom_types[chosen] else None
    squared = segment_box_squared(offset, axis, list(scene.half_extents.T))
    reach = jnp.asarray(robot.geom_radii[chosen] ** 2, q.dtype)[:, None]
    return jnp.all(squared > reach, axis=0) | ~scene.mask


def moved_by_joint(robot: Robot) -> list[bool]:
    """Whether each collision geom is moved by some joint."""
    moved: list[bool] = []
    for body in robot.bodies:
        moved.append(bool(body.joints) or (body.parent >= 0 and moved[body.parent]))
    return [b >= 0 and moved[b] for b in robot.geom_bodies.tolist()]


def _segments(
    robot: Robot, joints: Joints, base: Frame = WORLD
) -> list[tuple[Vector, Vector | None]]:
    """Centre and half axis (None for a sphere) of every collision geom, m; see `body_frames`."""
    frames = body_frames(robot, joints, base)
    segments = []
    for g, body in enumerate(robot.geom_bodies):
        position, rotation = frames[body] if body >= 0 else base
        center = transform(position, rotation, robot.geom_centers[g].tolist())
        axis = None
        if robot.geom_types[g] == CAPSULE:
            axis = [dot(row, robot.geom_axes[g].tolist()) for row in rotation]
        segments.append((center, axis))
    return segments


def _fused(robot: Robot, axis_aligned: bool):
    require_round_geoms(robot)
    radii = robot.geom_radii.tolist()
    moving = np.flatnonzero(moved_by_joint(robot)).tolist()
    # A capsule takes about as much code as eight spheres.
    work = sum(8 if robot.geom_types[g] == CAPSULE else 1 for g in moving)
    # Rotated boxes share no work, so nothing is gained by taking several at a time.
    most_boxes_a_pass = max(1, _BOX_PAIRS_A_PASS // max(1, work)) if axis_aligned else 1
    num_self = -(-len(robot.self_pairs) // _SELF_PAIRS_A_PASS)
    self_parts = np.array_split(robot.self_pairs, max(1, num_self))

    def smaller(a, b):
        # Not jnp.minimum: that must return NaN for NaN, which costs three instructions instead of
        # one. NaN configurations are refused by the joint limits.
        return jnp.where(a < b, a, b)

    def box_pass(joints, origins, rotations, half_extents, gap):
        # Kinematics in the frame of each box are less work than moving every sphere there. Boxes
        # that are not rotated share most of it, which the compiler finds out.
        if rotations is None:
            rotations = [WORLD[1]] * len(origins)
        bases = [
            (list(o), [list(row) for row in r]) for o, r in zip(origins, rotations, strict=True)
        ]
        views = [_segments(robot, joints, base) for base in bases]
        smallest = jnp.full(joints.values.shape[1:], jnp.inf, joints.values.dtype)
        for g in moving:
            for view, extents in zip(views, half_extents, strict=True):
                squared = segment_box_squared(*view[g], list(extents))
                smallest = smaller(gap(squared, radii[g]), smallest)
        return smallest

    def self_pass(joints, pairs, gap):
        segments = _segments(robot, joints)
        smallest = jnp.full(joints.values.shape[1:], jnp.inf, joints.values.dtype)
        for i, j in pairs:
            squared = segment_segment_squared(*segments[i], *segments[j])
            smallest = smaller(gap(squared, radii[i] + radii[j]), smallest)
        return smallest

    def smallest_gap(scene: Scene, q: jax.Array, gap, worth_going_on) -> jax.Array:
        boxes_a_pass = max(1, min(most_boxes_a_pass, len(scene.mask)))
        # Padding boxes go far away, and to the end where they are skipped altogether.
        order = jnp.argsort(~scene.mask)
        origins, rotations = -jnp.where(scene.mask[:, None], scene.centers, _FAR)[order], None
        if not axis_aligned:
            rotations = rotation_matrices(scene.quats)[order].swapaxes(-1, -2)
            origins = jnp.sum(rotations * origins[:, None], axis=-1)
        pad = -len(scene.mask) % boxes_a_pass
        origins = jnp.pad(origins, ((0, pad), (0, 0)), constant_values=_FAR)
        half_extents = jnp.pad(scene.half_extents[order], ((0, pad), (0, 0)))
        num_passes = (scene.mask.sum() + boxes_a_pass - 1) // boxes_a_pass
        joints = joint_terms(robot, q)

        def one_pass(i, smallest):
            # The barrier keeps the compiler from moving the kinematics out of the loop, which
            # would send every sphere's coordinates through memory: three times slower.
            fresh, smallest = jax.lax.optimization_barrier((joints, smallest))

            def part(array):
                return jax.lax.dynamic_slice_in_dim(array, i * boxes_a_pass, boxes_a_pass)

            # The rotations may be None.
            origin, rotation, extents = jax.tree.map(part, (origins, rotations, half_extents))
            return smaller(box_pass(fresh, origin, rotation, extents, gap), smallest)

        smallest = jnp.full(q.shape[:-1], jnp.inf, q.dtype)
        smallest = jax.lax.fori_loop(0, num_passes, one_pass, smallest)
        for part in self_parts:

            def self_turn(_, smallest, part=part):
                fresh, smallest = jax.lax.optimization_barrier((joints, smallest))
                return smaller(self_pass(fresh, part, gap), smallest)

            # A loop of one turn or none, for the same reason as above; none where it cannot matter.
            turns = jnp.any(worth_going_on(smallest)).astype(jnp.int32)
            smallest = jax.lax.fori_loop(0, turns, self_turn, smallest)
        return smallest

    def clearance(scene: Scene, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        def gap(squared, reach):
            return jnp.sqrt(squared) - reach

        return smallest_gap(scene, q, gap, lambda gaps: gaps == gaps)

    def collision_free(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        # Squares compare like distances and need no root.
        gaps = smallest_gap(
            scene, nodes, lambda squared, reach: squared - reach**2, lambda g: g > 0
        )
        return gaps > 0

    # Traced once a shape, however often a function that is compiled around it asks.
    return clearance, jax.jit(collision_free)
