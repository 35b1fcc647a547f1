"""Validity of configurations and edges: fused kernels, and their first level through MJX.

A `Checker` is pure functions for one scene; `vmap` them over scenes. The fused backend
generates straight-line code from the robot's constants (see `kinematics.py`); the MJX backend runs
MuJoCo's own collision functions on the spheres that the fused one tests first.

Geoms that no joint moves (an arm's base) are not tested against boxes: no configuration changes
the outcome. `obstacles_clear` tests them, once a scene.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import can_rest
from gnnjax.collision.cloud import with_clouds
from gnnjax.collision.edges import (
    EdgeChecks,
    bisection_order,
    cut_edges,
    most_intervals,
    test_edges,
)
from gnnjax.collision.fused import fused_functions
from gnnjax.collision.levels import BLOCKED, Levels
from gnnjax.collision.spheres import in_table
from gnnjax.collision.stretches import Edges, Stretches
from gnnjax.devices import in_single_precision
from gnnjax.errors import InputError
from gnnjax.scene.scene import Scene

Backend: TypeAlias = Literal["fused", "mjx"]

EDGE_RESOLUTION = 0.05  # rad (or m) between neighbouring configurations tested along an edge


class Checker(NamedTuple):
    """The collision functions of one robot.

    `clearance(scene, q [*batch D]) -> [*batch]` m, positive when clear of boxes and itself.
    `check_configurations(scene, nodes [B D]) -> [B]`, true where valid.
    `place(scenes [P])` is what the next one needs of scenes, computed once for many calls.
    `check_each(placed, owner [G], nodes [G T D]) -> [G T]`, groups of T that share a scene.
    `check_edges(scene, starts [E D], ends [E D]) -> EdgeChecks [E]`; tests the configurations
    between the ends, which the caller has tested as nodes.
    `edges_free(scene, starts [E D], ends [E D]) -> [E]`, the `valid` of the same for hundreds of
    edges in a third of the time; nobody learns how many configurations were looked at, since most
    verdicts follow from those of others (`stretches.py`).
    """

    clearance: Callable[[Scene, jax.Array], jax.Array]
    check_configurations: Callable[[Scene, jax.Array], jax.Array]
    place: Callable[[Scene], Any]
    check_each: Callable[[Any, jax.Array, jax.Array], jax.Array]
    check_edges: Callable[[Scene, jax.Array, jax.Array], EdgeChecks]
    edges_free: Callable[[Scene, jax.Array, jax.Array], jax.Array]
    levels: Levels | None = None  # `check_each` in two steps, where it has two


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
        backend: "fused" (fast and exact), or "mjx" (of the spheres around the arm's parts alone).
        axis_aligned: promise that no box is rotated; the fused kernel then skips the rotation.
        resolution: largest distance of neighbouring configurations along an edge.

    Raises:
        InputError: an unknown backend, or a resolution too fine for the arm's joint ranges.
    """
    if backend == "fused":
        functions = fused_functions(robot, axis_aligned)
    elif backend == "mjx":
        from gnnjax.collision.mjx import mjx_functions

        functions = mjx_functions(robot)
    else:
        raise InputError(f"no collision backend {backend!r}; there are 'fused' and 'mjx'")
    of_others, functions = functions, with_clouds(robot, functions)
    lower, upper = robot.joint_lower, robot.joint_upper

    def inside_limits(nodes: jax.Array) -> jax.Array:
        # NaN fails these comparisons, so that it can never count as valid.
        inside = jnp.all((nodes >= lower) & (nodes <= upper), axis=-1)
        return inside if robot.rest_limit is None else inside & can_rest(robot, nodes)

    def check_configurations(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        return inside_limits(nodes) & functions.collision_free(scene, nodes)

    def check_each(
        placed: Any, owner: Int[Array, " G"], nodes: Float[Array, "G T D"]
    ) -> Bool[Array, "G T"]:
        return inside_limits(nodes) & functions.collision_free_each(placed, owner, nodes)

    most = most_intervals(robot, resolution)

    def check_edges(
        scene: Scene, starts: Float[Array, "E D"], ends: Float[Array, "E D"]
    ) -> EdgeChecks:
        order = bisection_order(most)
        return test_edges(check_configurations, order, resolution, scene, starts, ends)

    def edges_free(
        scene: Scene, starts: Float[Array, "E D"], ends: Float[Array, "E D"]
    ) -> Bool[Array, " E"]:
        # Torques at rest may be too large between two places where they are not.
        by_points = (
            backend != "fused" or robot.rest_limit is not None or in_table(robot.sphere_pairs)
        )
        if scene.cloud is not None or by_points:
            return check_edges(scene, starts, ends).valid
        *cut, testable = cut_edges(starts, ends, resolution, most)
        edges = Edges(*cut)
        second = None if of_others.levels is None else of_others.levels.second
        placed = of_others.place(jax.tree.map(lambda x: x[None], scene))
        valid = testable & edges.within(inside_limits)
        return Stretches(robot, second, most).free(placed, edges, valid)

    levels = functions.levels
    if levels is not None:
        first, second = levels

        def check_first(placed: Any, owner: jax.Array, nodes: jax.Array) -> jax.Array:
            return jnp.where(inside_limits(nodes), first(placed, owner, nodes), BLOCKED)

        levels = Levels(check_first, second)
    return Checker(
        functions.clearance,
        _single(check_configurations),
        functions.place,
        check_each,
        _single(check_edges),
        _single(edges_free),
        levels,
    )


def _single(function: Callable) -> Callable:
    """A function of a scene and configurations, in single precision whatever is set or given."""

    @functools.wraps(function)
    def single(scene: Scene, *configurations: ArrayLike) -> Any:
        with in_single_precision():
            return function(scene, *(jnp.asarray(q, jnp.float32) for q in configurations))

    return single
