"""Random scenes, and paths scanned finely with MuJoCo's C engine."""

import itertools

import mujoco
import numpy as np

from gnnjax.scene.mujoco_world import build_world, place_obstacles
from gnnjax.scene.scene import make_scene


def random_scene(rng, num=3):
    """Rotated boxes within reach of a small arm."""
    centers = rng.uniform(-0.9, 0.9, (num, 3))
    # Far enough from the base, which is a ball of 0.1 m at the origin.
    centers *= np.maximum(1, 0.5 / np.linalg.norm(centers, axis=1))[:, None]
    quats = rng.normal(size=(num, 4))
    return make_scene(centers, rng.uniform(0.03, 0.15, (num, 3)), quats)


def collides_anywhere(robot, scene, *paths, step=0.002):
    """Tests paths every `step` (configuration units) with MuJoCo's C engine."""
    model = build_world(robot, len(scene.mask))
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene)
    for start, end in itertools.chain(*map(itertools.pairwise, paths)):
        count = int(np.ceil(np.linalg.norm(end - start) / step))
        for fraction in np.linspace(0, 1, count + 1):
            data.qpos[:] = start + fraction * (end - start)
            mujoco.mj_fwdPosition(model, data)
            if (data.contact.dist[: data.ncon] < -1e-6).any():
                return True
    return False
