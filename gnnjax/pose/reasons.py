"""What stands in the way of a pose that no valid configuration reaches."""

from collections import Counter

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import rest_fault, rests
from gnnjax.pose.goal import AXES, PoseGoal, tool_frame
from gnnjax.pose.inverse import Solutions, inverse_kinematics
from gnnjax.scene.mujoco_world import deepest_contact
from gnnjax.scene.scene import Scene


def why_none(
    robot: Robot, goal: PoseGoal, scene: Scene, found: Solutions, margin: float = 0.0
) -> str:
    """The joint limits, contacts or weights that are in the way, in one sentence.

    Args:
        robot: the arm.
        goal: one pose.
        scene: the scene.
        found: from `inverse_kinematics`, none of it valid.
        margin: clearance from obstacles, m.
    """
    tool = f"{tool_frame(robot, goal.frame).name} of {robot.name}"
    reached = found.q[found.reached]
    if len(reached):
        return _contacts(robot, tool, scene, reached, margin)
    return _limits(robot, tool, goal, found)


def _limits(robot: Robot, tool: str, goal: PoseGoal, found: Solutions) -> str:
    most = goal.tolerance
    place, turn = float(found.position_error[0]), float(found.rotation_error[0])
    far = _missing(1e3 * place, 1e3 * most[0], ".1f")
    away = f"{far} mm and {_missing(turn, most[1], '.3f')} rad"
    stops = [
        f"{name} at its limit of {value:.4g}"
        for name, value, low, high in zip(
            robot.joint_names, found.q[0], robot.joint_lower, robot.joint_upper, strict=True
        )
        if not low < value < high
    ]
    there = " and ".join(stops) or "no joint at a limit"
    places, turns = AXES[:3], AXES[3:]
    # Of a pose that is a turn alone, nothing would be left.
    if not set(places) <= set(goal.free) and not set(turns) <= set(goal.free):
        free = [*goal.free, *(axis for axis in turns if axis not in goal.free)]
        alone = inverse_kinematics(robot, goal._replace(free=free), near=found.q[0])
        there += f"; if it may turn freely, it comes to {1e3 * alone.position_error[0]:.1f} mm"
    return (
        f"{tool} does not reach the pose: at the nearest it is {away} away, with {there}; "
        "choose a pose within reach, free an axis, or allow more tolerance"
    )


def _missing(error: float, most: float, form: str) -> str:
    """An error that may be more than it should be, and then is not said to be nothing."""
    text = f"{error:{form}}"
    return f"{error:.2g}" if error > most and not float(text) else text


def _contacts(robot: Robot, tool: str, scene: Scene, reached: np.ndarray, margin: float) -> str:
    pairs: Counter[str] = Counter()
    held = rests(robot, reached)
    for q, good in zip(reached, held, strict=True):
        contact = deepest_contact(robot, scene, q)
        if contact:
            pairs[f"{contact.first} with {contact.second}"] += 1
        elif not good:
            pairs[f"joint {rest_fault(robot, q)[0]} is too weak to hold the arm"] += 1
        elif margin:
            pairs[f"the arm comes within {1e3 * margin:g} mm of an obstacle"] += 1
        else:
            pairs["too near to a contact to rule it out"] += 1
    listed = ", ".join(f"{what} in {count}" for what, count in pairs.most_common(3))
    return (
        f"{tool} reaches the pose in {len(reached)} configurations found, and "
        f"{'all collide' if held.all() else 'none is valid'}: {listed}; move the pose, or free an "
        "axis"
    )
