"""Allowed contacts: bodies of an arm that may touch obstacles, a gripper its handle, say.

They are left out of every test, however deep the overlap, and out of clearances; whoever cannot do
that refuses the scene. They are of one arm, and no other takes them.
"""

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief, is_list, is_pair_of_names
from gnnjax.scene.scene import Allowed, Scene, obstacle_name

_HELD = "held"  # stands for the body that an arm holds


def allow_contacts(robot: Robot, scene: Scene, allow: Sequence) -> Scene:
    """The scene in which bodies of the arm may touch obstacles, beside those that may already.

    Args:
        robot: the arm; `attach` makes another one.
        scene: one scene, not a batch.
        allow: pairs of a body, by its name, and an obstacle, as messages call it: its kind, and its
            number among those, as in ("hand", "cylinder 0"). "held" is what the arm holds.

    Raises:
        InputError: no such body or obstacle.
    """
    if np.ndim(scene.mask) != 1:
        raise InputError(f"the mask of the scene has shape {np.shape(scene.mask)}; give one scene")
    if not is_list(allow) or not all(is_pair_of_names(pair) for pair in allow):
        raise InputError(
            f'allow is {brief(allow)}; give pairs of names, such as [("hand", "cylinder 0")]'
        )
    pairs = np.zeros((len(scene.mask), len(robot.bodies)), bool)
    if scene.allowed is not None:
        check_allowed(robot, scene)
        pairs |= np.asarray(scene.allowed.pairs)
    if not allow:
        return scene
    names = {obstacle_name(scene, i): i for i in np.flatnonzero(scene.mask).tolist()}
    for body, obstacle in allow:
        if obstacle not in names:
            raise InputError(
                f"no obstacle {obstacle!r} to be touched; the scene has {brief(list(names))}"
            )
        pairs[names[obstacle], _body(robot, body)] = True
    return scene._replace(allowed=Allowed(pairs, arm_key(robot)))


def _body(robot: Robot, name: str) -> int:
    known = [body.name for body in robot.bodies]
    if name in known and name:
        return known.index(name)
    if name == _HELD and len(robot.held_bodies) == 1:
        return robot.held_bodies[0]
    raise InputError(f"no body {name!r} in {robot.name} to touch an obstacle; there are {known}")


def last_link(robot: Robot) -> int:
    """Index of the arm's last body, but for what it holds, which may hang on one before."""
    return max({*range(len(robot.bodies))} - {*robot.held_bodies})


def arm_key(robot: Robot) -> np.uint32:
    """Tells arms with other bodies apart."""
    return np.uint32(zlib.crc32("\n".join(body.name for body in robot.bodies).encode()))


def check_allowed(robot: Robot, scene: Scene) -> None:
    """Refuses a scene, or scenes, whose allowed contacts are of another arm."""
    allowed = scene.allowed
    if allowed is None:
        return
    pairs, mask = np.asarray(allowed.pairs), np.asarray(scene.mask)
    fits = pairs.dtype == bool and pairs.shape == (*mask.shape, len(robot.bodies))
    check_arm(robot, allowed.arm, fits and np.shape(allowed.arm) == mask.shape[:-1])


def check_arm(robot: Robot, arm: ArrayLike, fits: bool = True) -> None:
    """Refuses allowed contacts of an arm, or arms, with another `arm_key`, or that do not fit
    otherwise."""
    if not fits or (np.asarray(arm) != arm_key(robot)).any():
        raise InputError(
            "the allowed contacts in this scene were declared for another arm, not "
            f"{robot.name}; name them for that arm with allow_contacts"
        )


def refuse_allowed(scene: Scene, who: str) -> None:
    """Refuses a scene, or scenes, for what knows of no allowed contacts.

    Raises:
        InputError: there are such contacts.
    """
    if scene.allowed is not None:
        raise InputError(
            f"the scene has allowed contacts, which {who} cannot leave out; take them out of the "
            "scene: `allow` of its file, or scene._replace(allowed=None)"
        )
