"""A query and its answer: what every planner checks first and what it returns."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import check_scene, configuration_clearance
from gnnjax.collision.fused import boxes_clear
from gnnjax.errors import InputError
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import Scene


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
        """Plans P problems that `check_query` accepts."""
        ...


def check_query(
    robot: Robot, scene: Scene, start: ArrayLike, goal: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Returns start and goal as arrays, or says what is wrong with the query.

    Raises:
        InputError: start or goal is no valid configuration, a box is none, or one stands in the
            base.
    """
    check_scene(scene)
    clear = base_clear(robot, scene)
    if not clear.all():
        raise InputError(
            f"box {int(np.argmin(clear))} of the scene touches the base of {robot.name}; "
            "move it away"
        )
    ends = []
    for name, q in (("start", start), ("goal", goal)):
        try:
            with np.errstate(over="ignore"):  # infinite in float32, and refused as such
                q = np.asarray(q, dtype=np.float32)
        except (TypeError, ValueError):
            raise InputError(f"{name} {q!r} is not a list of numbers") from None
        if q.shape != (robot.num_dof,):
            raise InputError(
                f"{name} has shape {q.shape}; {robot.name} needs {robot.num_dof} joint values"
            )
        bad = ~((q >= robot.joint_lower) & (q <= robot.joint_upper))
        if bad.any():
            joint = int(bad.argmax())
            raise InputError(
                f"{name} has {q[joint]:.4g} for joint {joint + 1}; it must lie between "
                f"{robot.joint_lower[joint]:.4g} and {robot.joint_upper[joint]:.4g}"
            )
        clearance = configuration_clearance(robot, scene, q)
        if clearance <= 0:
            raise InputError(
                f"{name} {np.round(q, 4).tolist()} is in collision "
                f"({-1e3 * clearance:.1f} mm deep); choose a free configuration"
            )
        ends.append(q)
    return ends[0], ends[1]


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


def base_clear(robot: Robot, scene: Scene) -> np.ndarray:
    """Tells for every box of a scene whether the arm's base is clear of it, `[M]`."""
    return np.asarray(_base_clear(robot)(scene))


@functools.cache
def _base_clear(robot: Robot) -> Callable[[Scene], jax.Array]:
    """The test of an arm's base against boxes, compiled."""
    home = jnp.asarray(robot.home)
    return jax.jit(functools.partial(boxes_clear, robot, q=home, base_only=True))
