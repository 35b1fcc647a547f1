"""Inverse kinematics: configurations that put a frame of the arm where it should be.

Descents from many configurations at once (`solver.py`): the first begins at the one that is wanted
near, the others at points of a Sobol sequence within the joint limits. What reaches the pose is
tested against the scene and the arm itself by what also tests the ends of queries.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from gnnjax.arm.parts import quat_to_matrix
from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import rests
from gnnjax.collision.certify import check_scene
from gnnjax.collision.clearances import clearances
from gnnjax.devices import (
    cache_compilations,
    in_single_precision,
    map_first,
    run_where_called,
)
from gnnjax.errors import InputError, brief, check_number, check_seed
from gnnjax.pose.chain import Chain, chain_of
from gnnjax.pose.goal import AXES, PoseGoal, check_goal, tool_frame
from gnnjax.pose.solver import LEVER, Reached, Target, descend
from gnnjax.roadmap.sobol import sobol_points
from gnnjax.scene.scene import Scene, inflated, make_scene
from gnnjax.scene.shapes import IDENTITY_QUAT

_DESCENTS = 64  # at once
_ROUNDS = 4  # of descents; the later ones where the earlier ones have found nothing valid
_POSES = 16  # at once, where there are many
_APART = 0.1  # configuration units; solutions that are closer to each other count as one


class Solutions(NamedTuple):
    """K configurations for a pose that differ by more than 0.1 rad, the best first.

    Those that are valid come first, the nearest before others; then those that reach the pose and
    collide, likewise; then the others by their error. Rows that are left over are NaN.
    """

    q: Float[np.ndarray, "*batch K D"]  # rad or m
    position_error: Float[np.ndarray, "*batch K"]  # m, along the axes that count
    rotation_error: Float[np.ndarray, "*batch K"]  # rad, likewise
    reached: Bool[np.ndarray, "*batch K"]  # both errors are within the tolerance
    valid: Bool[
        np.ndarray, "*batch K"
    ]  # reached, clear of the scene and of the arm itself, and held
    distance: Float[np.ndarray, "*batch K"]  # from the configuration that is wanted near


@in_single_precision()
def inverse_kinematics(
    robot: Robot,
    goal: PoseGoal,
    scene: Scene | None = None,
    *,
    near: ArrayLike | None = None,
    num_solutions: int = 8,
    margin: float = 0.0,
    seed: int = 0,
) -> Solutions:
    """Finds configurations whose frame is at a pose, or at each of several.

    Compiles on the first call for an arm and a frame of it.

    Args:
        robot: the arm.
        goal: the pose or poses.
        scene: what configurations have to be clear of, beside the arm itself.
        near: `[D]`, which solutions are wanted near to; by default the arm's home.
        num_solutions: K.
        margin: clearance from obstacles, m.
        seed: of where descents begin.

    Raises:
        InputError: a goal, scene or configuration that is none.
    """
    position, quat = check_goal(goal)
    if (
        isinstance(num_solutions, bool)
        or not isinstance(num_solutions, int | np.integer)
        or num_solutions < 1
    ):
        raise InputError(f"num_solutions is {num_solutions}; ask for 1 or more")
    check_number(margin, "margin")
    if not margin >= 0:
        raise InputError(f"margin is {margin}; it must be 0 m or more")
    home = _configuration(robot, near)
    if scene is None:
        scene = _no_scene()
    else:
        check_scene(scene)
    scene = inflated(scene, margin)
    targets = _targets(goal, position.reshape(-1, 3), quat.reshape(-1, 4))
    num = len(targets.position)
    found: list[list[Solutions]] = [[] for _ in range(num)]
    left = np.arange(num)
    for number in range(_ROUNDS):
        starts = _starts(robot, goal.frame, home, check_seed(seed), number)
        for first in range(0, len(left), _POSES):
            rows = left[first : first + _POSES]
            ends = _ends(robot, goal, targets, rows, starts)
            judged = _judged(robot, scene, goal, home, ends)
            for i, row in enumerate(rows):
                found[row].append(Solutions(*(x[i] for x in judged)))
        left = np.array([row for row in left if not found[row][-1].valid.any()], int)
    chosen = [_distinct(parts, num_solutions) for parts in found]
    batch = position.shape[:-1]
    stacked = (np.stack(x).reshape(*batch, *x[0].shape) for x in zip(*chosen, strict=True))
    return Solutions(*stacked)


@functools.cache
def prepare(robot: Robot, frame: str | None) -> None:
    """Compiles what `inverse_kinematics` needs."""
    goal = PoseGoal(np.zeros(3), IDENTITY_QUAT, frame=frame)
    targets = _targets(goal, np.zeros((1, 3)), np.array([IDENTITY_QUAT]))
    _ends(robot, goal, targets, np.zeros(1, int), _starts(robot, frame, robot.home, 0, 0))


@functools.cache
def _no_scene() -> Scene:
    return make_scene([], [])


def _configuration(robot: Robot, near: ArrayLike | None) -> np.ndarray:
    if near is None:
        return robot.home
    try:
        q = np.asarray(near, np.float32)
    except (TypeError, ValueError, OverflowError):
        q = np.zeros(0, np.float32)
    if q.shape != (robot.num_dof,) or not np.isfinite(q).all():
        raise InputError(f"near is {brief(near)}; {robot.name} needs {robot.num_dof} joint values")
    return q


def _targets(goal: PoseGoal, position: np.ndarray, quat: np.ndarray) -> Target:
    """Poses `[P ...]` as the solver takes them."""
    counts = np.array([axis not in goal.free for axis in AXES], np.float32)
    counts = np.broadcast_to(counts, (len(position), 6))
    rotation = np.stack([quat_to_matrix(x) for x in quat]).astype(np.float32)
    return Target(position.astype(np.float32), rotation, counts[:, :3], counts[:, 3:])


def _starts(
    robot: Robot, frame: str | None, home: np.ndarray, seed: int, number: int
) -> np.ndarray:
    """Where the descents of a round begin, `[S D]`. In the first, joints that do not move the frame
    are where they are at home, from where no descent takes them."""
    points = _points(robot.num_dof, seed, number)
    starts = robot.drawn_lower + points * (robot.drawn_upper - robot.drawn_lower)
    if number == 0:
        at_home = np.clip(home, robot.joint_lower, robot.joint_upper)
        beside = ~np.isin(np.arange(robot.num_dof), _chain(robot, frame).joints)
        starts[:, beside] = at_home[beside]
        starts[0] = at_home
    return starts.astype(np.float32)


@functools.lru_cache(maxsize=64)
def _points(num_dims: int, seed: int, number: int) -> np.ndarray:
    return sobol_points(num_dims, seed, number * _DESCENTS, _DESCENTS)


@functools.cache
def _chain(robot: Robot, frame: str | None) -> Chain:
    return chain_of(robot, tool_frame(robot, frame))


@functools.cache
def _compiled(robot: Robot, frame: str | None) -> Callable[..., Reached]:
    """Descends to the first of some poses `[P ...]` from the same configurations `[S D]` each."""
    cache_compilations()
    run_where_called()
    chain = _chain(robot, frame)

    def function(targets: Target, num: jax.Array, starts: jax.Array) -> Reached:
        return map_first(lambda target: descend(robot, chain, target, starts), num, targets)

    return jax.jit(function)


def _ends(
    robot: Robot, goal: PoseGoal, targets: Target, rows: np.ndarray, starts: np.ndarray
) -> Reached:
    """Where the descents to some poses end, `[R S ...]`."""
    padded = np.pad(rows, (0, _POSES - len(rows)), mode="edge")
    chosen = jax.tree.map(lambda x: x[padded], targets)
    found = _compiled(robot, goal.frame)(chosen, np.int32(len(rows)), starts)
    return Reached(*(np.asarray(x)[: len(rows)] for x in found))


def _judged(
    robot: Robot, scene: Scene, goal: PoseGoal, home: np.ndarray, ends: Reached
) -> Solutions:
    """All ends of descents `[R S ...]`, whether they are solutions or not."""
    q = np.asarray(ends.q)
    # Of joints that turn more than once, the turn within limits that is nearest.
    lower, upper = robot.joint_lower - q, robot.joint_upper - q
    turns = np.clip(
        np.round((home - q) / (2 * np.pi)),
        np.ceil(lower / (2 * np.pi)),
        np.floor(upper / (2 * np.pi)),
    )
    turns = np.where(robot.turns_more_than_once, turns, 0)
    turned = (q + 2 * np.pi * turns).astype(np.float32)
    inside = (turned >= robot.joint_lower) & (turned <= robot.joint_upper)
    q = np.where(inside, turned, q)
    place, turn = np.asarray(ends.position_error), np.asarray(ends.rotation_error)
    most_away, most_turned = (float(x) for x in goal.tolerance)
    reached = (place <= most_away) & (turn <= most_turned)
    valid = reached.copy()
    if reached.any():
        free = clearances(robot, scene, q[reached], most=0.0) > 0
        valid[reached] = free & rests(robot, q[reached])
    return Solutions(q, place, turn, reached, valid, np.linalg.norm(q - home, axis=-1))


def _distinct(parts: list[Solutions], num: int) -> Solutions:
    """The best of several `[S ...]` of which no two are close to each other, `[num ...]`."""
    found = Solutions(*(np.concatenate(x) for x in zip(*parts, strict=True)))
    error = found.position_error + LEVER * found.rotation_error
    order = np.lexsort(
        (np.where(found.reached, found.distance, error), ~found.reached, ~found.valid)
    )
    chosen: list[int] = []
    while len(order) and len(chosen) < num:
        best = order[0]
        chosen.append(int(best))
        order = order[np.linalg.norm(found.q[order] - found.q[best], axis=1) > _APART]

    def padded(values: np.ndarray) -> np.ndarray:
        blank = False if values.dtype == bool else np.nan
        full = np.full((num, *values.shape[1:]), blank, values.dtype)
        full[: len(chosen)] = values[chosen]
        return full

    return Solutions(*map(padded, found))
