"""Collision checking with MJX, MuJoCo's own collision functions in JAX.

Slower than the fused kernels, but independent of them, and not confined to spheres and capsules.
"""

import contextlib
import io
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.scene.mujoco_world import FAR_AWAY, build_world, obstacles
from gnnjax.scene.scene import Scene

with contextlib.redirect_stdout(io.StringIO()):  # it prints when the optional Warp is missing
    from mujoco import mjx


def mjx_functions(
    robot: Robot, max_boxes: int
) -> tuple[Callable[[Scene, jax.Array], jax.Array], Callable[[Scene, jax.Array], jax.Array]]:
    """Builds the functions `clearance` and `collision_free` of a `Checker` on MJX.

    `clearance(scene, q [*batch D]) -> [*batch]` m is the least distance over MJX's contacts. Its
    sign is right; its size, where positive, is none to rely on: MJX sets the distance of a sphere
    or capsule and a box to 1 m, or leaves it approximate, once they are separated. Below zero it
    is minus the depth of the deepest penetration. The fused backend gives the true distance.

    Args:
        robot: the arm.
        max_boxes: padded number of boxes of the scenes; their arrays must have this size.

    Raises:
        InputError: the arm has something that MJX does not simulate.
    """
    world = build_world(robot, max_boxes)
    try:
        # Named, since MJX would choose another implementation by the device and what is installed.
        model = mjx.put_model(world, impl="jax")
        blank = mjx.make_data(world, impl="jax")
    except (NotImplementedError, ValueError) as error:
        raise InputError(
            f"MJX cannot collide {robot.name}: {str(error).strip()}; cover its geoms with spheres "
            "(python -m gnnjax.fit does)"
        ) from None
    _, box_geoms, mocaps = obstacles(world, max_boxes)
    far = np.array([[FAR_AWAY, 0.0, i] for i in range(max_boxes)]).reshape(max_boxes, 3)

    def clearance(scene: Scene, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        if len(scene.mask) != max_boxes:
            raise InputError(
                f"the scene has room for {len(scene.mask)} boxes, the MJX checker for {max_boxes}; "
                "build it with the scene's max_boxes"
            )
        centers = jnp.where(scene.mask[:, None], scene.centers, far)
        placed = model.tree_replace(
            {"geom_size": jnp.asarray(model.geom_size).at[box_geoms].set(scene.half_extents)}
        )
        still = blank.replace(
            mocap_pos=blank.mocap_pos.at[mocaps].set(centers),
            mocap_quat=blank.mocap_quat.at[mocaps].set(scene.quats),
        )

        def one(configuration: jax.Array) -> jax.Array:
            # Positions are all that contacts need: no full forward pass.
            data = mjx.kinematics(placed, still.replace(qpos=configuration))
            return _smallest_distance(mjx.collision(placed, data))

        return jax.vmap(one)(q.reshape(-1, q.shape[-1])).reshape(q.shape[:-1])

    def collision_free(scene: Scene, nodes: Float[Array, "B D"]) -> Bool[Array, " B"]:
        return clearance(scene, nodes) > 0

    return clearance, collision_free


def _smallest_distance(data: mjx.Data) -> jax.Array:
    """Least contact distance [m], of one configuration; the only place that looks inside MJX."""
    return jnp.min(data._impl.contact.dist, initial=jnp.inf)
