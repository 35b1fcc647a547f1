"""A query and its answer: what every planner checks first and what it returns."""

import logging
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.meetings import remedy_of
from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import rest_fault, rests
from gnnjax.arm.turns import limit_fault
from gnnjax.collision.certify import check_scene
from gnnjax.collision.clearances import base_clear, clearances
from gnnjax.collision.obstacles import obstacles_of, scene_faults
from gnnjax.errors import InputError, as_typed, brief, one_line
from gnnjax.problems.problem import Problem
from gnnjax.scene.allowed import check_allowed
from gnnjax.scene.mujoco_world import deepest_contact, depth_in_base, nearest_things
from gnnjax.scene.scene import Scene, inflated, obstacle_name
from gnnjax.scene.units import doubtful_units
from gnnjax.trajectory.trajectory import Trajectory

_LOG = logging.getLogger(__name__)

# m; how far what the base stands on may reach into it.
BASE_CONTACT = 0.005


class Plan(NamedTuple):
    """The answer to a query."""

    success: bool
    reason: str  # why there is no path; empty on success
    path: np.ndarray  # [L D] configurations from start to goal; [0 D] without success
    cost: float  # length of the path, configuration units; inf without success
    certified: bool  # the path is proven free of collisions all along
    edge_checks: int | None  # None for a planner that never asks about an edge
    configuration_checks: int  # all of them: sampling and search
    sampling_checks: int  # start, goal and the draws for nodes
    search_checks: int  # along edges
    planning_time_s: float  # from the roadmap to the path
    total_time_s: float  # from the query to the path
    roadmaps: int  # roadmaps sampled; 1 for planners that have none
    trajectory: Trajectory | None = None  # the motion along the path, where one was asked for
    valid: bool = True  # False: the query was refused, for `reason`, and nothing was searched


@runtime_checkable
class QueryPlanner(Protocol):
    """What a planner is to `evaluate`."""

    @property
    def robot(self) -> Robot:
        """The arm."""
        ...

    @property
    def radius(self) -> float | None:
        """Of the roadmaps, configuration units; None for a planner without."""
        ...

    def warm_up(self, scene: Scene, batch_size: int = 1) -> None:
        """Compiles what planning in scenes like this may need."""

    def plan_batch(self, problems: Problem, *, seed: int = 0) -> list[Plan]:
        """Plans P problems; plans of those that `check_query` refuses are not `valid`."""
        ...


def check_query(
    robot: Robot, scene: Scene, start: ArrayLike, goal: ArrayLike, margin: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Returns start and goal as arrays, or says what is wrong with the query.

    Logs a line where the scene looks as if it were in millimetres.

    Args:
        robot: the arm.
        scene: one scene.
        start: configuration.
        goal: configuration.
        margin: clearance that both must have from obstacles, m.

    Raises:
        InputError: start or goal is no valid configuration, an obstacle is none, or stands in the
            base.
    """
    check_scene(scene)
    ends = []
    for name, q in (("start", start), ("goal", goal)):
        try:
            q = _single(q)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{name} {q!r} is not a list of numbers") from None
        if q.shape != (robot.num_dof,):
            raise InputError(
                f"{name} has shape {q.shape}; {robot.name} needs {robot.num_dof} joint values"
            )
        ends.append(q)
    if doubt := doubtful_units(robot, scene):
        _LOG.warning("%s", doubt)
    query = jax.tree.map(lambda x: np.asarray(x)[None], Problem(ends[0], ends[1], scene))
    (reason,) = _reasons(robot, query, [None], margin)
    if reason is not None:
        raise InputError(reason)
    return ends[0], ends[1]


def check_queries(robot: Robot, problems: Problem, margin: float = 0.0) -> list[str | None]:
    """What is wrong with each of P problems, as `check_query` says it; None where nothing is.

    Args:
        robot: the arm.
        problems: `[P, ...]`.
        margin: clearance that ends must have from obstacles, m.

    Raises:
        InputError: arrays of other shapes, which are no problems at all.
    """
    if not isinstance(problems, Problem):
        raise InputError(
            f"problems are {brief(problems)}; give one Problem, its scenes of "
            "stack_scenes([...]), starts and goals [P, D]"
        )
    return _reasons(robot, problems, scene_faults(problems.scene), margin)


def _reasons(
    robot: Robot, problems: Problem, faults: list[str | None], margin: float
) -> list[str | None]:
    """`check_queries`, where what is wrong with each scene is known."""
    reasons = list(faults)
    wanted = (len(reasons), robot.num_dof)
    starts, goals = _single(problems.start), _single(problems.goal)
    if np.ndim(problems.scene.mask) != 2 or not starts.shape == goals.shape == wanted:
        raise InputError(
            f"starts have shape {starts.shape}, goals {goals.shape} and the masks of scenes "
            f"{np.shape(problems.scene.mask)}; {robot.name} needs [P, {robot.num_dof}] twice and "
            "[P, M]"
        )
    rows = np.flatnonzero([reason is None for reason in reasons])
    scenes = jax.tree.map(lambda x: np.asarray(x)[rows], problems.scene)
    ends = np.concatenate([starts[rows], goals[rows]])
    owner = np.tile(np.arange(len(rows)), 2)
    check_allowed(robot, scenes)
    known = obstacles_of(scenes)
    thick = inflated(scenes, margin) if margin else known
    clearance = clearances(robot, thick, ends, owner, most=0.0).reshape(2, -1)
    found = [
        _base_reasons(robot, scenes, base_clear(robot, known)),
        _end_reasons(robot, "start", scenes, starts[rows], clearance[0], margin),
        _end_reasons(robot, "goal", scenes, goals[rows], clearance[1], margin),
    ]
    for row, *why in zip(rows, *found, strict=True):
        reasons[row] = next(filter(None, why), None)
    return [reason and one_line(reason) for reason in reasons]


def plan_valid(
    robot: Robot, problems: Problem, margin: float, plan: Callable[[Problem], list[Plan]]
) -> list[Plan]:
    """Plans those of P problems that are valid; the plans of others tell what is wrong with them.

    Total times hold what checking the queries took, in equal shares.

    Args:
        robot: the arm.
        problems: `[P, ...]`.
        margin: clearance that ends must have from obstacles, m.
        plan: plans valid ones.

    Raises:
        InputError: arrays of other shapes, which are no problems at all.
    """
    begin = time.perf_counter()
    reasons = check_queries(robot, problems, margin)
    share = (time.perf_counter() - begin) / max(1, len(reasons))
    good = np.flatnonzero([reason is None for reason in reasons])
    if len(good) < len(reasons):
        problems = jax.tree.map(lambda x: np.asarray(x)[good], problems)
    plans = dict(zip(good.tolist(), plan(problems) if len(good) else [], strict=True))
    nothing = dict.fromkeys(("edge_checks", "sampling_checks", "search_checks", "roadmaps"), 0)
    nothing |= dict.fromkeys(("planning_time_s", "total_time_s"), 0.0)
    found = [
        plans.get(i) or make_plan(None, reason or "", robot.num_dof, valid=False, **nothing)
        for i, reason in enumerate(reasons)
    ]
    return [plan._replace(total_time_s=plan.total_time_s + share) for plan in found]


def _base_reasons(robot: Robot, scenes: Scene, clear: np.ndarray) -> list[str | None]:
    """Which obstacle stands in the base, for each of P scenes, of which some are clear `[P M]`."""
    reasons: list[str | None] = [None] * len(clear)
    for i in np.flatnonzero(~clear.all(axis=1)).tolist():
        scene = jax.tree.map(lambda x, i=i: x[i], scenes)
        # Spheres stand out of the base, and it stands on something.
        for touching in np.flatnonzero(~clear[i]).tolist():
            depth = depth_in_base(robot, scene, touching)
            if depth > BASE_CONTACT:
                reasons[i] = (
                    f"{obstacle_name(scene, touching)} of the scene reaches {1e3 * depth:.0f} mm "
                    f"into the base of {robot.name}; move it away"
                )
                break
    return reasons


def _end_reasons(
    robot: Robot, name: str, scenes: Scene, q: np.ndarray, clearance: np.ndarray, margin: float
) -> list[str | None]:
    """What is wrong with configurations `[P, D]` that have so much clearance `[P]`."""
    reasons: list[str | None] = [None] * len(q)
    outside = ~((q >= robot.joint_lower) & (q <= robot.joint_upper))
    too_weak = ~rests(robot, q)
    for i in np.flatnonzero(outside.any(axis=1) | ~(clearance > 0) | too_weak):
        if fault := limit_fault(robot, q[i]):
            joint, said = fault
            # Of hinges alone: nobody gives metres in degrees.
            degrees = _is_hinge(robot, joint) and 2 * np.pi < abs(q[i, joint]) < np.inf
            reasons[i] = f"{name} {said}" + (" (radians; are these degrees?)" if degrees else "")
            continue
        rounded = as_typed(np.round(q[i], 4))
        if clearance[i] > 0:
            joint, what = rest_fault(robot, q[i])
            reasons[i] = (
                f"at {name} {rounded} joint {joint} {what}; carry less, allow a larger share, or "
                "choose another configuration"
            )
            continue
        contact = deepest_contact(robot, jax.tree.map(lambda x, i=i: x[i], scenes), q[i])
        if contact:
            reasons[i] = (
                f"{name} {rounded} is in collision: {contact.first} and {contact.second} overlap "
                f"by {1e3 * contact.depth:.1f} mm{remedy_of(robot, contact.first, contact.second)}"
            )
        elif margin:
            reasons[i] = (
                f"{name} {rounded} is within the margin of {1e3 * margin:g} mm of an obstacle; "
                "choose another one, or less margin"
            )
        else:
            near = nearest_things(robot, jax.tree.map(lambda x, i=i: x[i], scenes), q[i])
            reasons[i] = (
                f"at {name} {rounded} {near or 'no contact can be ruled out'}; choose one that "
                "leaves them more room"
            )
    return reasons


def _is_hinge(robot: Robot, joint: int) -> bool:
    return any(j.index == joint and j.hinge for body in robot.bodies for j in body.joints)


def unit_of(robot: Robot) -> str:
    """What joint values are in, and so costs, for people to read."""
    hinges = {joint.hinge for body in robot.bodies for joint in body.joints}
    return " and ".join(unit for unit, hinge in (("rad", True), ("m", False)) if hinge in hinges)


def _single(q: ArrayLike) -> np.ndarray:
    """Configurations as planners take them."""
    with np.errstate(over="ignore"):  # infinite in float32, and refused as such
        return np.asarray(q, dtype=np.float32)


def path_length(path: np.ndarray) -> float:
    """Length of a path `[L D]`, configuration units."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def make_plan(path: np.ndarray | None, reason: str, num_dof: int, **costs: Any) -> Plan:
    """The plan of a planner that certifies its paths.

    Args:
        path: `[L D]` configurations; None without success.
        reason: why there is no path.
        num_dof: D.
        costs: the other fields of `Plan`, all configuration checks apart.
    """
    success = path is not None
    nodes = np.zeros((0, num_dof), np.float32) if path is None else path
    return Plan(
        success=success,
        reason="" if success else reason,
        path=nodes,
        cost=path_length(nodes) if success else np.inf,
        certified=success,
        configuration_checks=costs["sampling_checks"] + costs["search_checks"],
        **costs,
    )
