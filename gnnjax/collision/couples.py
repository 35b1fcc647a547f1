"""Two parts of an arm that few joints move against each other: how, and what bounds their distance.

In NumPy and double precision. A couple holds nothing but what it depends on, so that what is worked
out of it is found again whatever else an arm has or holds.
"""

from typing import NamedTuple

import numpy as np

from gnnjax.arm.bodies import Joint
from gnnjax.arm.robot import Robot
from gnnjax.arm.transforms import behind, transform_of
from gnnjax.collision.reaches import Line, reach_between, ways_apart

MOST_JOINTS = 3


class Step(NamedTuple):
    """What lies behind a joint, in the frame behind the one before."""

    parts: np.ndarray  # [4 3 4], see `behind`
    joint: int  # which of K; -1 for none
    hinge: bool
    axis: np.ndarray  # [3]
    anchor: np.ndarray  # [3] m


class Side(NamedTuple):
    """One of two parts, and the way to it from the last body that moves both."""

    steps: tuple[Step, ...]
    vertices: np.ndarray  # [V 3] m, in the frame behind the last step
    radius: float  # m, of the ball around each point of theirs
    centers: np.ndarray  # [S 3] m, of the spheres that enclose it
    radii: np.ndarray  # [S] m
    inner: np.ndarray  # [S] m, of those inside of it; not above 0: there is none


class Couple(NamedTuple):
    """Two parts that K joints move against each other."""

    sides: tuple[Side, Side]
    pairs: np.ndarray  # [N 2] of their spheres
    lower: np.ndarray  # [K] rad or m
    upper: np.ndarray  # [K] rad or m
    reference: np.ndarray  # [K] where bodies lie as the file places them


def couple_of(
    robot: Robot, parts: list[int], pairs: np.ndarray, vertices: np.ndarray, radii: np.ndarray
) -> tuple[np.ndarray, Couple] | None:
    """The joints that move two parts against each other, `[K]`, and all that tells how; None of
    more than three joints, and of none.

    Args:
        robot: the arm.
        parts: both.
        pairs: of spheres `[N 2]`, one of each part, in any order.
        vertices: of all parts' hulls.
        radii: of all parts' balls.
    """
    ways = ways_apart(robot.bodies, *(robot.parts[p].body for p in parts))
    joints = sorted(j.index for way in ways for b in way for j in robot.bodies[b].joints)
    if not 1 <= len(joints) <= MOST_JOINTS:
        return None

    def steps(way: list[int]) -> tuple[Step, ...]:
        found = []
        for body in (robot.bodies[b] for b in way):
            own = transform_of(body.rotation, body.position)
            for joint in body.joints or (None,):
                found.append(_step(own, joint, joints))
                own = transform_of(np.eye(3), np.zeros(3))
        return tuple(found)

    sides = []
    swapped = np.where((robot.sphere_parts[pairs[:, :1]] == parts[0]), pairs, pairs[:, ::-1])
    local = []
    for side, (part, way) in enumerate(zip(parts, ways, strict=True)):
        spheres, at = np.unique(swapped[:, side], return_inverse=True)
        local.append(at.reshape(-1))
        hull = np.unique(vertices[part], axis=0).astype(float), float(radii[part])
        around = robot.sphere_centers[spheres], robot.sphere_radii[spheres]
        sides.append(Side(steps(way), *hull, *around, robot.sphere_inner_radii[spheres]))
    at = np.array(joints)
    limits = robot.joint_lower[at].astype(float), robot.joint_upper[at].astype(float)
    reference = robot.mj_model.qpos0[at]
    return at, Couple((sides[0], sides[1]), np.stack(local, axis=1), *limits, reference)


def _step(own: np.ndarray, joint: Joint | None, joints: list[int]) -> Step:
    if joint is None:
        return Step(behind(own, None), -1, False, np.zeros(3), np.zeros(3))
    return Step(
        behind(own, joint), joints.index(joint.index), joint.hinge, joint.axis, joint.anchor
    )


def ranges(couple: Couple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From where to where the cells go, `[K]`, one turn of joints that turn at least as far, and
    which these are."""
    hinges = np.zeros(len(couple.lower), bool)
    for step in (step for side in couple.sides for step in side.steps if step.joint >= 0):
        hinges[step.joint] = step.hinge
    # The lower end as the kernels have it.
    lower = couple.lower.astype(np.float32).astype(float)
    turns = hinges & (couple.upper - lower >= 2 * np.pi)
    upper = np.where(turns, lower + 2 * np.pi, couple.upper)
    return lower, upper, turns


def frames_of(couple: Couple, side: Side, q: np.ndarray) -> np.ndarray:
    """What lies behind each of a side's steps, `[1 + steps, N, 3, 4]`, at joint values `[N K]`; the
    first is where both sides begin."""
    frames = [np.broadcast_to(np.eye(3, 4), (len(q), 3, 4))]
    for step in side.steps:
        still, by_cosine, by_sine, by_value = step.parts
        value = q[:, step.joint] - couple.reference[step.joint] if step.joint >= 0 else 0 * q[:, 0]
        value = value[:, None, None]
        own = still + by_cosine * np.cos(value) + by_sine * np.sin(value) + by_value * value
        moved = frames[-1][..., :3] @ own
        moved[..., 3] += frames[-1][..., 3]
        frames.append(moved)
    return np.stack(frames)


def unproven_by_spheres(couple: Couple, q: np.ndarray) -> np.ndarray:
    """Whether spheres leave it open that the parts touch, at joint values `[N K]`."""
    first, second = (
        frame[..., :3] @ side.centers.T + frame[..., 3:]
        for side in couple.sides
        for frame in [frames_of(couple, side, q)[-1]]
    )
    i, j = couple.pairs.T
    apart = np.sqrt(sum((first[:, a, i] - second[:, a, j]) ** 2 for a in range(3)))
    one, other = couple.sides
    clear = (apart > one.radii[i] + other.radii[j]).all(axis=1)
    inside = (one.inner[i] > 0) & (other.inner[j] > 0)
    touching = (inside & (apart <= one.inner[i] + other.inner[j])).any(axis=1)
    return ~clear & ~touching


def reaches(couple: Couple) -> np.ndarray:
    """How much the distance of the parts changes at most by a unit of each joint, m/rad or m/m."""
    ends, lines = [], []
    for side in couple.sides:
        frames = frames_of(couple, side, couple.lower[None])[:, 0]
        ends.append(side.vertices @ frames[-1][:, :3].T + frames[-1][:, 3])
        lines.append(
            [
                Line(
                    step.joint,
                    step.hinge,
                    frame[:, :3] @ step.axis,
                    frame[:, :3] @ step.anchor + frame[:, 3],
                    0.0 if step.hinge else couple.upper[step.joint] - couple.lower[step.joint],
                )
                for step, frame in zip(side.steps, frames[1:], strict=True)
                if step.joint >= 0
            ]
        )
    way = lines[0][::-1] + lines[1]  # from the one part to the other
    found = np.empty(len(way))
    joints, *both = reach_between(ends, way)
    found[joints] = np.minimum(*(reach.max(axis=0) for reach in both))
    return found
