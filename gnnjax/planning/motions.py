"""The motions along the paths of plans."""

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief
from gnnjax.planning.query import Plan
from gnnjax.scene.scene import Scene
from gnnjax.trajectory.options import MotionOptions, check_motion_options
from gnnjax.trajectory.trajectory import find_motions


def motion_options(robot: Robot, trajectory: bool | MotionOptions) -> MotionOptions | None:
    """What motions are wanted, refused before planning, if at all; None without."""
    if trajectory is None or isinstance(trajectory, bool | np.bool_):
        options = MotionOptions() if trajectory else None
    elif isinstance(trajectory, MotionOptions):
        options = trajectory
    else:
        raise InputError(
            f"trajectory is {brief(trajectory)}; give True or MotionOptions(...), such as "
            "MotionOptions(acceleration=8.0)"
        )
    if options is not None:
        check_motion_options(robot, options)
    return options


def with_motions(
    robot: Robot, plans: list[Plan], scenes: Scene, options: MotionOptions | None, margin: float
) -> list[Plan]:
    """Plans in P scenes `[P ...]`, with the motions along their paths where they are wanted."""
    if options is None:
        return plans
    solved = [i for i, plan in enumerate(plans) if plan.success]
    own = jax.tree.map(lambda x: np.asarray(x)[solved], scenes)
    paths = [plans[i].path for i in solved]
    found = find_motions(robot, own, paths, options, margin, proven=True)
    plans = list(plans)
    for i, each in zip(solved, found, strict=True):
        plans[i] = plans[i]._replace(trajectory=each)
    return plans
