"""Parts of an arm that meet nearly wherever it is, and what to do about that."""

import functools

import mujoco
import numpy as np

from gnnjax.arm.robot import Robot

_OFTEN = 0.5  # share of configurations from which on another one is no remedy
_SAMPLES = 200


def remedy_of(robot: Robot, first: str, second: str) -> str:
    """What to do about a contact, for a message that has named both: parts of the arm, or a part
    and something else."""
    another = "; choose a free configuration"
    numbers = {part.name: number for number, part in enumerate(robot.parts)}
    if not {first, second} <= numbers.keys():
        return another
    pair = numbers[first], numbers[second]
    bodies = [robot.parts[p].body for p in pair]
    names = [robot.bodies[b].name if b >= 0 else "world" for b in bodies]
    share = meeting_share(robot, *pair)
    if share < _OFTEN or not all(names):
        return another
    said = f", as they do in {100 * share:.0f} % of all configurations; "
    links = [name for b, name in zip(bodies, names, strict=True) if b not in robot.held_bodies]
    if len(links) < 2:
        named = f"let allow of what is held name {links[0]!r}, or " if links else ""
        return f"{said}{named}hold it in another pose"
    return f"{said}if they may, give allow=[({links[0]!r}, {links[1]!r})]"


@functools.lru_cache(maxsize=256)
def meeting_share(robot: Robot, first: int, second: int) -> float:
    """Share of random configurations in which two parts overlap."""
    model = robot.mj_model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    geoms = [int(robot.part_geoms[part]) for part in (first, second)]
    count = 0
    for q in rng.uniform(robot.joint_lower, robot.joint_upper, (_SAMPLES, robot.num_dof)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        count += mujoco.mj_geomDistance(model, data, *geoms, 0.01, None) < 0
    return count / _SAMPLES
