"""What planners are beside their options: their arm, weights, and what a caller put into them."""

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm.sources import sources_sha256
from gnnjax.errors import InputError, brief
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.planner import Planner
from gnnjax.planning.query import QueryPlanner


def checksums_of(planner: QueryPlanner) -> dict[str, str | None]:
    """Checksums of the files of a planner's arm, and of its weights, wherever they came from; None
    of one without."""
    arm = sources_sha256(planner.robot.path)
    return {"robot_sha256": arm, "weights_sha256": _of_weights(planner)}


def _of_weights(planner: QueryPlanner) -> str | None:
    if not isinstance(planner, Planner) or planner.strategy.weights is None:
        return None
    leaves = [np.asarray(x) for x in jax.tree.leaves(planner.strategy.weights)]
    shapes = repr([(x.dtype.str, x.shape) for x in leaves]).encode()
    return hashlib.sha256(shapes + b"".join(x.tobytes() for x in leaves)).hexdigest()


def check_arm(planner: QueryPlanner, told: Robot) -> None:
    """Refuses a planner of another arm than the one that its results would tell.

    Raises:
        InputError: it is.
    """
    if planner.robot.name != told.name:
        raise InputError(
            f"the planner is of {planner.robot.name}, and results would tell {told.name}; give the "
            "configuration the planner's robot, and what was chosen and attached of it"
        )


def own_settings(
    planner: QueryPlanner, options: PlannerOptions, results: Sequence[Path]
) -> dict[str, Any]:
    """What to tell of a planner beside the options that its results are said to be of.

    The time limit is that of the options, whatever the planner's.

    Args:
        planner: that a caller made.
        options: that its results tell.
        results: where they are, or some of them may be.

    Raises:
        InputError: the planner has other options; or a guide or scorer of its own, where there are
            results already: whether these are of the same one, no file tells.
    """
    if not isinstance(planner, Planner):
        return {}
    for field in dataclasses.fields(PlannerOptions):
        theirs, ours = (getattr(x, field.name) for x in (planner.options, options))
        if field.name != "time_limit" and str(theirs) != str(ours):
            raise InputError(
                f"the planner has {field.name} {brief(theirs)}, and results would tell "
                f"{brief(ours)}; give both the same"
            )
    own = [name for name, value in planner.given.items() if value is not None]
    if not own:
        return {}
    if there := [path for path in results if path.exists()]:
        raise InputError(
            f"{str(there[0])!r} is there, and whether its rows are of the same {own[0]} of your "
            "own, nobody can tell; remove it, or name another file"
        )
    return {"own": own}
