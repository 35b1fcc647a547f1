"""Scenes as batches `[P, ...]`, with room in each for what the largest has."""

from collections.abc import Sequence

import jax
import numpy as np

from gnnjax.errors import InputError
from gnnjax.scene.cloud import no_cloud, with_room
from gnnjax.scene.scene import Scene, check_is_scene, pad_scene


def stack_scenes(scenes: Sequence[Scene]) -> Scene:
    """Scenes as one batch `[P, M, ...]`, with room in each for as many obstacles and points as the
    largest has.

    Raises:
        InputError: no scene, or one in which contacts are meant of another arm.
    """
    for scene in scenes:
        check_is_scene(scene)
    if not scenes:
        raise InputError("there are no scenes to stack; give one or more")
    most = max(scene.mask.shape[-1] for scene in scenes)
    padded = _same_allowed(same_clouds([pad_scene(scene, most) for scene in scenes]))
    return jax.tree.map(lambda *x: np.stack(x), *padded)


def same_clouds(scenes: Sequence[Scene]) -> list[Scene]:
    """Scenes, or batches of scenes, whose clouds have room for as many points; where one has a
    cloud, all have one, if need be without points."""
    rooms = [scene.cloud.points.shape[-2] for scene in scenes if scene.cloud is not None]
    if not rooms:
        return list(scenes)

    def with_cloud(scene: Scene) -> Scene:
        if scene.cloud is not None:
            return scene._replace(cloud=with_room(scene.cloud, max(rooms)))
        batch, none = scene.mask.shape[:-1], no_cloud(max(rooms))
        return scene._replace(
            cloud=jax.tree.map(lambda x: np.broadcast_to(x, (*batch, *np.shape(x))), none)
        )

    return [with_cloud(scene) for scene in scenes]


def _same_allowed(scenes: Sequence[Scene]) -> list[Scene]:
    """Single scenes; where one has allowed contacts, all have, if need be none of them."""
    meant = [scene.allowed for scene in scenes if scene.allowed is not None]
    if not meant:
        return list(scenes)
    if len({int(x.arm) for x in meant}) > 1:
        raise InputError(
            "the allowed contacts in these scenes were declared for several arms; stack scenes of "
            "one arm"
        )
    none = meant[0]._replace(pairs=np.zeros_like(meant[0].pairs))
    return [x if x.allowed is not None else x._replace(allowed=none) for x in scenes]
