"""Motions by toppra (Pham and Pham, 2018), an oracle for those that are found here."""

import logging
import warnings
from typing import Any

import numpy as np

from gnnjax.errors import InputError
from gnnjax.trajectory.curve import Curve, places
from gnnjax.trajectory.limits import Limits

_FINER = 2  # than the curve's own grid


def duration_by_toppra(curve: Curve, limits: Limits) -> float | None:
    """Seconds that the fastest motion along a curve takes, from rest to rest, under limits of
    velocity and acceleration; None where toppra finds none.

    Args:
        curve: without stops.
        limits: of D joints; of torques and jerk nothing is asked.

    Raises:
        InputError: no toppra.
    """
    try:
        with warnings.catch_warnings():
            # Of its strings, when Python first compiles them.
            warnings.simplefilter("ignore", DeprecationWarning)
            warnings.simplefilter("ignore", SyntaxWarning)
            from toppra import algorithm, constraint
            from toppra.interpolator import AbstractGeometricPath
    except ImportError as error:
        raise InputError(f"no toppra ({error}); pip install 'gnnjax[experiments]'") from None
    logging.getLogger("toppra").setLevel(logging.ERROR)
    own = np.unique(np.asarray(curve.grid, float))
    number = np.arange(len(curve.grid))

    class Path(AbstractGeometricPath):
        dof = property(lambda self: len(curve.start))
        path_interval = property(lambda self: own[[0, -1]])
        waypoints = property(lambda self: (own, self(own)))

        def __call__(self, path_positions: Any, order: int = 0) -> np.ndarray:
            s = np.atleast_1d(path_positions)
            found = places(curve, np.interp(s, curve.grid, number))
            values = np.asarray((found.q, found.slope, found.bend)[order])
            return values if np.ndim(path_positions) else values[0]

    def both_ways(most: np.ndarray) -> np.ndarray:
        return np.stack([-most, most], axis=1)

    finer = np.linspace(own[:-1], own[1:], _FINER, endpoint=False, axis=1).ravel()
    search = algorithm.TOPPRA(
        [
            constraint.JointVelocityConstraint(both_ways(limits.velocity)),
            constraint.JointAccelerationConstraint(
                both_ways(limits.acceleration),
                discretization_scheme=constraint.DiscretizationType.Interpolation,
            ),
        ],
        Path(),
        gridpoints=np.append(finer, own[-1]),
        solver_wrapper="seidel",
    )
    found = search.compute_trajectory(0, 0)
    return None if found is None else float(found.duration)
