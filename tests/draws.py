"""Configurations and boxes drawn at random, of tests in several files."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gnnjax.scene.scene import Scene, box_scene, make_scene


def random_configurations(rng, robot, num):
    """`[num, D]` float32 within the joint limits, which rounding must not leave."""
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (num, robot.num_dof))
    return np.clip(q.astype(np.float32), robot.joint_lower, robot.joint_upper)


def random_boxes(rng, num, *, rotated=True, reach=0.9):
    """A scene of boxes of 0.1 to 0.5 m, on the device."""
    centers = rng.uniform(-reach, reach, (num, 3))
    quats = rng.normal(size=(num, 4)) if rotated else None
    scene = make_scene(centers, rng.uniform(0.05, 0.25, (num, 3)), quats)
    return jax.tree.map(jnp.asarray, scene)


def boxes_and_padding(seed=0, num_boxes=4, padding=2) -> Scene:
    """Rotated boxes, and padding that has a size, too."""
    rng = np.random.default_rng(seed)
    total = num_boxes + padding
    quats = Rotation.random(total, rng=rng).as_quat(scalar_first=True)
    return box_scene(
        centers=jnp.asarray(rng.uniform(-0.8, 0.8, (total, 3)), jnp.float32),
        half_extents=jnp.asarray(rng.uniform(0.15, 0.5, (total, 3)), jnp.float32),
        quats=jnp.asarray(quats, jnp.float32),
        mask=jnp.asarray(np.arange(total) < num_boxes),
    )
