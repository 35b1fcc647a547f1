"""Scenes that look as if they were in millimetres."""

import functools

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.scene.scene import Scene
from gnnjax.scene.shapes import HALF_SPACE

_FAR = 3.0  # times the arm's reach
_LARGE = 100.0  # times its longest link


def doubtful_units(robot: Robot, scene: Scene) -> str | None:
    """What is odd about the sizes of one scene; None where nothing is.

    Half-spaces, which have no size, count for nothing. A cloud out of reach is warned of when it is
    made; one within is a sign that all is in metres.
    """
    half_extents = np.asarray(scene.half_extents, float)
    chosen = np.asarray(scene.mask) & ~(half_extents == HALF_SPACE).all(axis=1)
    cloud = scene.cloud
    if not chosen.any() or (cloud is not None and cloud.num):
        return None
    disc, ball = np.asarray(scene.radii, float)[chosen].T
    sizes = half_extents[chosen] + disc[:, None] * [1, 1, 0]
    away = np.linalg.norm(np.asarray(scene.centers, float)[chosen], axis=1)
    nearest = (away - np.linalg.norm(sizes, axis=1) - ball).min()
    reach, link = _lengths(robot)
    question = "is the scene in millimetres? lengths are in metres, in the frame of the arm's base"
    if nearest > _FAR * reach:
        return (
            f"every obstacle of the scene is {nearest:.3g} m or more from {robot.name}, which "
            f"reaches no further than {reach:.3g} m; {question}"
        )
    smallest = (sizes.max(axis=1) + ball).min()
    if smallest > _LARGE * link:
        return (
            f"every obstacle of the scene is larger than {smallest:.3g} m, and the longest link of "
            f"{robot.name} {link:.3g} m; {question}"
        )
    return None


@functools.cache
def _lengths(robot: Robot) -> tuple[float, float]:
    """How far the arm reaches at most, and its longest link, m."""
    travel = np.abs(robot.mj_model.jnt_range).max(axis=1)
    reaches, links = [], []
    for body in robot.bodies:
        before = reaches[body.parent] if body.parent >= 0 else 0.0
        slides = sum(float(travel[joint.index]) for joint in body.joints if not joint.hinge)
        # A hinge off the origin of its body swings that around itself.
        anchors = sum(2 * float(np.linalg.norm(joint.anchor)) for joint in body.joints)
        links.append(float(np.linalg.norm(body.position)))
        reaches.append(before + links[-1] + slides + anchors)
    for b, center, radius in zip(
        robot.sphere_bodies.tolist(), robot.sphere_centers, robot.sphere_radii, strict=True
    ):
        links.append(float(np.linalg.norm(center) + radius))
        reaches.append((reaches[b] if b >= 0 else 0.0) + links[-1])
    return max(reaches), max(links)
