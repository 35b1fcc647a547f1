"""The fused kernels: straight-line code, generated from a robot's constants (see `kinematics.py`).

Geoms that no joint moves (an arm's base) are not tested against obstacles: no configuration changes
the outcome. `boxes_clear` tests them, once a scene.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

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
from gnnjax.scene.scene import Scene, rotation_matrices
from gnnjax.scene.shapes import for_every_kind

# Squared distance of a segment to an obstacle, seen from the obstacle.
_SQUARED = for_every_kind("fused kernel", box=segment_box_squared)

# Geometry pairs in one pass of the fused kernel. The compiler turns a pass into a single loop over
# the batch. It splits what exceeds 2,000 operations into functions, and where it fails to join them
# again, the loop runs several times slower.
_BOX_PAIRS_A_PASS = 250
_SELF_PAIRS_A_PASS = 600
_FAR = 1e6  # m; where padding boxes are


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
    squared = _SQUARED["box"](offset, axis, list(scene.half_extents.T))
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


def fused_functions(
    robot: Robot, axis_aligned: bool
) -> tuple[Callable[[Scene, jax.Array], jax.Array], Callable[[Scene, jax.Array], jax.Array]]:
    """Builds the functions `clearance` and `collision_free` of a `Checker` of fused kernels.

    Args:
        robot: the arm.
        axis_aligned: promise that no box is rotated; the kernel then skips the rotation.

    Raises:
        InputError: the arm has geoms other than spheres and capsules.
    """
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
                squared = _SQUARED["box"](*view[g], list(extents))
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
