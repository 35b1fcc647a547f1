"""What a depth camera sees of boxes: a point for each of its pixels."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gnnjax.scene.scene import Scene, rotation_matrices

WIDTH, HEIGHT = 64, 48  # pixels
_TANGENTS = 0.75, 0.56  # of half the angles of view


def look_at(
    scene: Scene, camera: Float[Array, "3"], target: Float[Array, "3"]
) -> Float[Array, "K 3"]:
    """Where the rays of a camera meet the first box each, in any unit; NaN where they meet none.

    Args:
        scene: boxes, none of which holds the camera.
        camera: where it stands.
        target: what is in the middle of its picture; not straight above or below it.
    """
    forward = _unit(target - camera)
    right = _unit(jnp.cross(forward, jnp.array([0.0, 0.0, 1.0])))
    u, v = (jnp.linspace(-t, t, n) for t, n in zip(_TANGENTS, (WIDTH, HEIGHT), strict=True))
    u, v = (x.reshape(-1, 1) for x in jnp.meshgrid(u, v))
    rays = forward + u * right + v * jnp.cross(right, forward)
    # In the frame of each box, where a ray is inside between its last entry into a pair of faces
    # and its first exit.
    to_box = rotation_matrices(scene.quats).swapaxes(-1, -2)
    origin = jnp.sum(to_box * (camera - scene.centers)[:, None], axis=-1)  # [M 3]
    way = jnp.sum(to_box[:, None] * rays[:, None], axis=-1)  # [M K 3]
    way = jnp.where(jnp.abs(way) > 1e-9, way, 1e-9)
    ends = (jnp.stack([-scene.half_extents, scene.half_extents]) - origin)[:, :, None] / way
    enters, leaves = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)  # [M K]
    met = scene.mask[:, None] & (enters < leaves) & (enters > 0)
    distance = jnp.min(jnp.where(met, enters, jnp.inf), axis=0)[:, None]
    return jnp.where(jnp.isfinite(distance), camera + distance * rays, jnp.nan)


def _unit(vector: jax.Array) -> jax.Array:
    return vector / jnp.linalg.norm(vector)
