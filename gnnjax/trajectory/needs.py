"""Torques along curves, by what they are made of."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from gnnjax.arm.robot import Robot
from gnnjax.clock import Clock
from gnnjax.trajectory.curve import Curve, places
from gnnjax.trajectory.dynamics import PathDynamics, path_dynamics

_ROWS = 1024  # places whose dynamics are computed at once


class Needs(NamedTuple):
    """Torques at P places of a curve, N m or N."""

    rest: Float[Array | np.ndarray, "*batch P D"]
    push: Float[Array | np.ndarray, "*batch P D"]  # of each unit/s^2
    speed: Float[Array | np.ndarray, "*batch P D"]  # of each unit^2/s^2
    damping: Float[Array | np.ndarray, "*batch P D"]  # of each unit/s
    dry: Float[Array | np.ndarray, "*batch P D"]  # while it moves


def needs_of(
    robot: Robot, curves: Sequence[Curve], at: Sequence[np.ndarray], clock: Clock
) -> list[Needs]:
    """Torques at grid indices `[P]` of curves."""
    found = [places(curve, own) for curve, own in zip(curves, at, strict=True)]
    place = [np.concatenate(x) for x in zip(*found, strict=True)]
    run, parts = _dynamics(robot), []
    with jax.enable_x64(True):
        for first in range(0, len(place[0]), _ROWS):
            rows = np.minimum(first + np.arange(_ROWS), len(place[0]) - 1)
            parts.append(clock.call(run, *(x[rows] for x in place)))
    joined = (np.concatenate(x)[: len(place[0])] for x in zip(*parts, strict=True))
    all_of = PathDynamics(*joined)
    dry = robot.mj_model.dof_frictionloss * np.sign(place[1])
    needs = all_of.rest, all_of.inertia, all_of.speed, all_of.damping, dry
    cuts = np.cumsum([len(own) for own in at])[:-1]
    return [Needs(*own) for own in zip(*(np.split(x, cuts) for x in needs), strict=True)]


@functools.cache
def _dynamics(robot: Robot) -> Callable[..., PathDynamics]:
    """`path_dynamics` of `_ROWS` places."""
    return jax.jit(functools.partial(path_dynamics, robot))
