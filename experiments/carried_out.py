"""What is measured of motions that an arm carries out.

A joint swings if it turns back three times or more, small movements left out. Out of one place and
into another it may have to turn back twice: to retreat first, and to go past the goal and come
back. Whoever turns back once more does again what was done before.

A problem is *held* if the arm can rest at its start and at its goal with what it carries, by the
share of its torques that motions may use. Where it cannot, no motion suits it, whatever is planned.
"""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.results import Row
from experiments.statistics import proportion
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.arm.torques import torques_at_rest
from gnnjax.measure.statistics import describe
from gnnjax.problems.problem import Problem
from gnnjax.scene.shapes import sphere
from gnnjax.trajectory.execution import Execution, execute_trajectories
from gnnjax.trajectory.limits import limits_of
from gnnjax.trajectory.simulate import ModelErrors
from gnnjax.trajectory.trajectory import time_paths

_SMALL = 0.05  # rad, of a movement that is none
SWINGS = 3  # times that a joint turns back
_BESIDE = 0.001  # m, radius of the payload: inside of the link that carries it


class Conditions(NamedTuple):
    """Under which motions are timed and carried out."""

    margin: float  # m, that paths keep from obstacles; curves keep half of it
    reserve: float  # share of the motors' torques that motions leave to the controller
    errors: ModelErrors  # that no controller knows


@functools.cache
def loaded(arm: str, payload: float) -> Robot:
    """The arm with a payload [kg] in its last link that adds nothing to what can collide."""
    robot = load_robot(arm)
    if not payload:
        return robot
    ball, own = sphere([0.0, 0.0, 0.0], _BESIDE), [x.name for x in robot.bodies if x.name]
    return robot.attach(own[-1], [ball], mass=payload, allow=["world", *own])


def carry_out(
    robot: Robot, problems: Problem, paths: list[Any], conditions: Conditions
) -> list[dict[str, Any]]:
    """Times all paths, which are None where none was found, and carries out their motions; a row a
    problem."""
    limit = limits_of(robot).torque
    torque = None if limit is None else (1 - conditions.reserve) * limit
    held = np.ones(len(paths), bool)
    if torque is not None:
        for q in (problems.start, problems.goal):
            held &= (np.abs(torques_at_rest(robot, np.asarray(q))) <= torque).all(axis=1)
    rows: list[dict[str, Any]] = [
        {"found": path is not None, "held": good, "timed": False}
        for path, good in zip(paths, held.tolist(), strict=True)
    ]
    found = np.flatnonzero([row["found"] for row in rows])
    scenes = jax.tree.map(lambda x: np.asarray(x)[found], problems.scene)
    own = [np.array(paths[i]) for i in found.tolist()]
    motions = time_paths(robot, scenes, own, margin=conditions.margin / 2, torque=torque)
    timed = np.flatnonzero([motion.success for motion in motions])
    executions = execute_trajectories(
        robot,
        jax.tree.map(lambda x: x[timed], scenes),
        [motions[i] for i in timed.tolist()],
        errors=conditions.errors,
    )
    for i, motion in zip(found.tolist(), motions, strict=True):
        rows[i] |= {"timed": motion.success, "reason": motion.reason}
    for i, execution in zip(found[timed].tolist(), executions, strict=True):
        rows[i] |= told(execution)
    return rows


def told(found: Execution) -> dict[str, Any]:
    """What is kept of an execution: a row, of which `summarize` makes one of many."""
    turns = turnings(found.trace.positions)
    return {
        "reason": found.reason,
        "touched": bool(found.touched),
        "settled": found.settled,
        "swings": bool(turns.max() >= SWINGS),
        "suitable": bool(found.success and turns.max() < SWINGS),
        "proven": found.proven,
        "turns": int(turns.sum()),
        "duration": found.duration,
        "max_error": float(found.max_error.max()),
        "tip_error": found.tip_error,
        "stray": found.stray,
        "torque_use": found.torque_use,
    }


def turnings(positions: np.ndarray, small: float = _SMALL) -> np.ndarray:
    """How often each joint turns back along positions `[T D]`, `[D]`; movements of less than
    `small` are none."""
    counts = np.zeros(positions.shape[1], int)
    for joint, values in enumerate(positions.T):
        # Whatever lies between two places where a joint turns changes nothing.
        ways = np.sign(np.diff(values))
        bends = values[np.concatenate([[True], ways[1:] != ways[:-1], [True]])]
        low = high = bends[0]
        heading = 0
        for value in bends:
            low, high = min(low, value), max(high, value)
            back = value < high - small if heading >= 0 else value > low + small
            if heading == 0 and value > low + small:
                heading = 1
            elif back:
                counts[joint] += heading != 0
                heading = -1 if heading >= 0 else 1
            else:
                continue
            low = high = value
    return counts


COUNTS = ("found", "held", "timed", "touched", "settled", "swings", "suitable", "proven")
_MEASURED = ("turns", "duration", "max_error", "tip_error", "stray", "torque_use")


def summarize(rows: list[dict[str, Any]]) -> Row:
    """Counts of problems, also of those that were planned again, the shares of them that were found
    and, of those that are held, whose motion is suitable, and what was measured of motions."""
    counts = {name: sum(bool(row.get(name)) for row in rows) for name in COUNTS}
    both = sum(row["held"] and bool(row.get("suitable")) for row in rows)
    timed = [row for row in rows if row["timed"]]
    measured = {name: np.array([row[name] for row in timed]) for name in _MEASURED}
    return {
        "accepted": len(rows),
        **counts,
        "again": sum(row.get("again", False) for row in rows),
        "suitable_held": both,
        "suitable_share": proportion(both, counts["held"]),
        "most_stray": float(measured["stray"].max(initial=0.0)),
        **{name: describe(each) if timed else None for name, each in measured.items()},
    }
