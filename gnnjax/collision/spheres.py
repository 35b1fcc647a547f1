"""Passes over the arm's spheres: straight-line code, generated from a robot's constants (see
`kinematics.py`), for one obstacle of each configuration, or some pairs of the arm's own spheres.

Configurations come in G groups of T that share a scene. What a pass needs of an obstacle is taken
out of a table once a group, and all configurations of the group are computed side by side with it.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gnnjax.arm.kinematics import (
    WORLD,
    Frame,
    Joints,
    Vector,
    body_frames,
    dot,
    joint_terms,
    subtract,
    transform_point,
)
from gnnjax.arm.robot import Robot
from gnnjax.collision.placed import Obstacle, Placed
from gnnjax.scene.geometry import squared_distance

# Pairs of the arm's own spheres in one pass. The compiler turns a pass into a single loop over the
# batch. It splits what exceeds 2,000 operations into functions, and where it fails to join them
# again, the loop runs several times slower.
_SELF_PAIRS_A_PASS, _SPHERES_A_PASS = 120, 64
# Of more pairs the code would take minutes to compile; they are looked up in tables instead.
_MOST_IN_CODE = 1200
_PAIRS_A_ROW = 64  # of a table
_ROUNDED = 1e-4  # m; by more than that, rounding moves no centre


def moved_by_joint(robot: Robot) -> list[bool]:
    """Whether each collision sphere is moved by some joint."""
    return (_links(robot) >= 0).tolist()


def _links(robot: Robot) -> np.ndarray:
    """Of each sphere the body whose joint moves it, of which those of one stay where they are
    among each other; -1 for those that no joint moves."""
    moves: list[int] = []
    for number, body in enumerate(robot.bodies):
        moves.append(number if body.joints else -1 if body.parent < 0 else moves[body.parent])
    return np.array([-1 if b < 0 else moves[b] for b in robot.sphere_bodies.tolist()], int)


def in_passes(rows: np.ndarray, most: int) -> list[np.ndarray]:
    """Rows in parts of about the same size, each of `most` or fewer; no part of none."""
    num = -(-len(rows) // most)
    return np.array_split(rows, num) if num else []


def placed_spheres(robot: Robot, joints: Joints, base: Frame = WORLD) -> list[Vector]:
    """Centre of every sphere, m; see `body_frames`."""
    frames = body_frames(robot, joints, base)
    points = []
    for body, center in zip(robot.sphere_bodies, robot.sphere_centers.tolist(), strict=True):
        position, rotation = frames[body] if body >= 0 else base
        points.append(transform_point(position, rotation, center))
    return points


def in_table(pairs: np.ndarray) -> bool:
    """Whether pairs of spheres are too many for straight-line code."""
    return len(pairs) > _MOST_IN_CODE


class PairTable(NamedTuple):
    """Pairs of an arm's own spheres in R rows, each of spheres of two links: for arms that have too
    many for straight-line code."""

    pairs: Int[np.ndarray, "R C 2"]
    squares: Float[np.ndarray, "R C"]  # m^2; of the sums of their radii
    near: Int[np.ndarray, "R 2"]  # a sphere of either link
    reach: Float[np.ndarray, " R"]  # m; how much nearer the surfaces of a pair may be than these


def pair_table(robot: Robot, wanted: np.ndarray) -> PairTable:
    """Of pairs `[S 2]` of an arm's spheres."""
    link = _links(robot)
    with jax.ensure_compile_time_eval():
        joints = joint_terms(robot, jnp.asarray(robot.home, jnp.float32))
        centers = np.array(placed_spheres(robot, joints), float)

    def around(spheres: np.ndarray) -> tuple[int, float]:
        """One of some spheres of a link, and the radius around its centre that holds them all."""
        apart = np.linalg.norm(centers[spheres, None] - centers[spheres], axis=-1)
        reach = (apart + robot.sphere_radii[spheres]).max(axis=1)
        return int(spheres[reach.argmin()]), reach.min()

    swap = (link[wanted[:, 0]] > link[wanted[:, 1]])[:, None]
    pairs = np.where(swap, wanted[:, ::-1], wanted)
    couples, of = np.unique(link[pairs], axis=0, return_inverse=True)
    rows = []
    for couple in range(len(couples)):
        own = pairs[of.reshape(-1) == couple]
        for row in in_passes(own, _PAIRS_A_ROW):
            (first, reach), (second, other) = (around(np.unique(x)) for x in row.T)
            full = np.pad(row, ((0, _PAIRS_A_ROW - len(row)), (0, 0)), "edge")
            rows.append((full, (first, second), reach + other + _ROUNDED))
    pairs, near, reach = (np.array(x) for x in zip(*rows, strict=True))
    squares = (robot.sphere_radii[pairs].sum(axis=-1) ** 2).astype(np.float32)
    pairs, near = pairs.astype(np.int32), near.astype(np.int32)
    return PairTable(pairs, squares, near, reach.astype(np.float32))


_Folded = TypeVar("_Folded")


class Passes:
    """The passes of one arm."""

    def __init__(self, robot: Robot, self_pairs: np.ndarray | None = None):
        """Args:
        robot: the arm.
        self_pairs: `[S 2]` of its own spheres, which are to be looked at; None: all that it has.
        """
        self._robot = robot
        own = robot.sphere_pairs if self_pairs is None else self_pairs
        # The spheres that joints move.
        self.moving = np.flatnonzero(moved_by_joint(robot)).tolist()
        # Those that are looked at together.
        self.groups = [x.tolist() for x in in_passes(np.array(self.moving), _SPHERES_A_PASS)]
        self._bodies = robot.sphere_bodies.tolist()
        # Of each pass over pairs of the arm's own spheres, the pairs.
        self.self_pairs = in_passes(own, _SELF_PAIRS_A_PASS)
        # All pairs once more, for what would take too long to compile as passes.
        self.table = pair_table(robot, own) if in_table(own) else None

    def to_obstacle(
        self, joints: Joints, obstacle: Obstacle, spheres: Sequence[int] | None = None
    ) -> Iterator[tuple[int, jax.Array, jax.Array]]:
        """Of every sphere that moves: its number, its centre's squared distance to the obstacle's
        box and disc, and the radius of the obstacle's ball. Where a contact is meant, the distance
        is infinite. Of some of `moving`, if they are named."""
        origin, rotation, half_extents, (disc, ball), allowed = obstacle
        # Kinematics in the frame of the obstacle are less work than moving every sphere there.
        turned = WORLD[1] if rotation is None else [list(row) for row in rotation]
        points = placed_spheres(self._robot, joints, (list(origin), turned))
        for g in self.moving if spheres is None else spheres:
            squared = squared_distance(points[g], list(half_extents), disc)
            if allowed is not None:
                squared = jnp.where(allowed[self._bodies[g]], jnp.inf, squared)
            yield g, squared, ball

    def to_itself(self, joints: Joints, pairs: np.ndarray) -> Iterator[tuple[int, int, jax.Array]]:
        """Of pairs of spheres: their numbers, and their centres' squared distance."""
        points = placed_spheres(self._robot, joints)
        for i, j in pairs.tolist():
            offset = subtract(points[i], points[j])
            # An array also of spheres that no joint moves against each other, as one on an axis: of
            # a Python number's comparisons ~ is another integer, and always true.
            yield i, j, jnp.asarray(dot(offset, offset), jnp.float32)

    def over_obstacles(
        self,
        joints: Joints,
        placed: Placed,
        owner: jax.Array,
        value: jax.Array,
        with_obstacle: Callable[[jax.Array, jax.Array, Iterator], jax.Array],
    ) -> jax.Array:
        """Folds what obstacles say of configurations.

        Args:
            joints: of configurations `[G T]`.
            placed: obstacles.
            owner: `[G]` whose obstacles count.
            value: `[G T]` what to begin with.
            with_obstacle: `(value, number of the obstacle, distances) -> value`; see `to_obstacle`.
        """
        own = Obstacle(*jax.tree.map(lambda x: x[..., owner, None], tuple(placed)[:-1]))

        # One obstacle a pass. With several, the compiler finds out what they share and the kernel
        # is a sixth faster, but it takes three times as long to compile. One array comes out, or
        # the compiler would compute all of it for each.
        def one_pass(i: jax.Array, value: jax.Array, spheres: list[int]) -> jax.Array:
            # The barrier keeps the compiler from moving the kinematics out of the loop, which
            # would send every sphere's coordinates through memory: three times slower.
            fresh, value = jax.lax.optimization_barrier((joints, value))
            obstacle = jax.tree.map(lambda x: x[i], own)
            return with_obstacle(value, i, self.to_obstacle(fresh, obstacle, spheres))

        most = jnp.max(placed.num[owner], initial=0)
        for spheres in self.groups:
            some = functools.partial(one_pass, spheres=spheres)
            value = jax.lax.fori_loop(0, most, some, value)
        return value

    def over_itself(
        self,
        joints: Joints,
        value: jax.Array,
        with_itself: Callable[[jax.Array, Iterator], jax.Array],
        with_row: Callable[[jax.Array, jax.Array, jax.Array], jax.Array],
        is_wanted: Callable[[jax.Array, jax.Array], jax.Array],
    ) -> jax.Array:
        """Folds what pairs of the arm's own spheres say of configurations.

        Args:
            joints: of configurations `[G T]`.
            value: `[G T]` what to begin with.
            with_itself: `(value, distances) -> value`; see `to_itself`.
            with_row: the same of a row of `table`, and
            is_wanted: which rows are to be looked at; see `over_table`.
        """
        if self.table is not None:
            return self.over_table(joints, value, with_row, is_wanted)
        for pairs in self.self_pairs:

            def self_turn(_, value: jax.Array, pairs: np.ndarray = pairs) -> jax.Array:
                fresh, value = jax.lax.optimization_barrier((joints, value))
                return with_itself(value, self.to_itself(fresh, pairs))

            # A loop of one turn or none, for the same reason as above; none where it cannot matter.
            turns = jnp.any(is_wanted(value, jnp.float32(-jnp.inf))).astype(jnp.int32)
            value = jax.lax.fori_loop(0, turns, self_turn, value)
        return value

    def over_table(
        self,
        joints: Joints,
        value: _Folded,
        fold: Callable[[_Folded, jax.Array, jax.Array], _Folded],
        is_wanted: Callable[[_Folded, jax.Array], jax.Array],
    ) -> _Folded:
        """Folds what the rows of `table` say.

        Args:
            joints: of configurations `[...]`.
            value: what to begin with.
            fold: `(value, number of the row, squared distances of its pairs [C ...]) -> value`.
            is_wanted: `(value, gap) -> [...]`, at which configurations a row is to be looked at
                whose pairs are apart by `gap`, m, at least. The gap may be NaN.
        """
        assert self.table is not None
        pairs, _, near, reach = map(jnp.asarray, self.table)
        shape = jnp.shape(joints.cos)[1:]
        points = placed_spheres(self._robot, joints)
        centers = jnp.stack([jnp.stack([jnp.broadcast_to(x, shape) for x in p]) for p in points])

        def squared(i: jax.Array, j: jax.Array) -> jax.Array:
            return jnp.sum((centers[i] - centers[j]) ** 2, axis=-len(shape) - 1)

        def row(number: jax.Array, value: _Folded) -> _Folded:
            gap = jnp.sqrt(squared(*near[number])) - reach[number]
            i, j = pairs[number].T
            return jax.lax.cond(
                jnp.any(is_wanted(value, gap)),
                lambda value: fold(value, number, squared(i, j)),
                lambda value: value,
                value,
            )

        return jax.lax.fori_loop(0, len(pairs), row, value)
