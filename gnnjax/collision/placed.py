"""Obstacles as kernels want them: of many scenes, in tables with the scenes last."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gnnjax.scene.scene import Scene, last_obstacle, rotation_matrices

FAR = 1e6  # m; where obstacles are that do not exist


class Placed(NamedTuple):
    """What passes need of M obstacles of each of P scenes."""

    origins: Float[Array, "M 3 P"]  # of the base, seen from the obstacle
    rotations: Float[Array, "M 3 3 P"] | None  # base to obstacle; None: none is rotated
    half_extents: Float[Array, "M 3 P"]
    radii: Float[Array, "M 2 P"]  # of disc and ball
    allowed: Bool[Array, "M L P"] | None  # bodies that may touch them; None: no scene says so
    num: Int[Array, " P"]  # none after so many exists


class Obstacle(NamedTuple):
    """One of the M of each of some configurations; as `Placed`."""

    origin: Float[Array, "3 ..."]
    rotation: Float[Array, "3 3 ..."] | None
    half_extents: Float[Array, "3 ..."]
    radii: Float[Array, "2 ..."]
    allowed: Bool[Array, "L ..."] | None


def place(scenes: Scene, axis_aligned: bool) -> Placed:
    """Of scenes `[P]`.

    Args:
        scenes: obstacles.
        axis_aligned: promise that none is rotated.
    """
    scenes = jax.tree.map(jnp.asarray, scenes)
    exists = scenes.mask
    # Those that do not exist are far away.
    origins, rotations = -jnp.where(exists[..., None], scenes.centers, FAR), None
    if not axis_aligned:
        rotations = rotation_matrices(scenes.quats).swapaxes(-1, -2)
        origins = jnp.sum(rotations * origins[..., None, :], axis=-1)
    allowed = None if scenes.allowed is None else scenes.allowed.pairs
    num = jax.vmap(last_obstacle)(exists)
    parts = Placed(origins, rotations, scenes.half_extents, scenes.radii, allowed, num)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), parts)
