"""MuJoCo's C engine as a judge of configurations, one after the other."""

import mujoco
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.scene.mujoco_world import build_world, place_obstacles
from gnnjax.scene.scene import Scene


class Engine:
    """MuJoCo's C engine on one scene."""

    def __init__(self, robot: Robot, scene: Scene, margin: float = 0.0):
        self.model = build_world(robot, len(scene.mask))
        self.model.geom_margin[:] = margin
        self.model.body_margin[:] = margin
        self.data = mujoco.MjData(self.model)
        place_obstacles(self.model, self.data, scene)

    def valid(self, q: np.ndarray) -> np.ndarray:
        """Whether no contact exists, of each configuration [N, D]; without a margin."""
        model, data = self.model, self.data
        qpos, num_contacts = data.qpos, np.empty(len(q), int)
        kinematics, collision = mujoco.mj_kinematics, mujoco.mj_collision
        for i, row in enumerate(q):
            qpos[:] = row
            kinematics(model, data)
            collision(model, data)
            num_contacts[i] = data.ncon
        return num_contacts == 0

    def gaps(self, q: np.ndarray) -> np.ndarray:
        """Least distance of contacts [N], m, infinite beyond the margin."""
        found = np.full(len(q), np.inf)
        for i, row in enumerate(q):
            self.valid(row[None])
            found[i] = min(self.data.contact.dist[: self.data.ncon], default=np.inf)
        return found


def empty_engine(num_dof: int) -> Engine:
    """An engine with joints but nothing to collide: its loop costs what Python costs."""
    engine = Engine.__new__(Engine)
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(mass=1, inertia=[1, 1, 1])
    for _ in range(min(num_dof, 3)):
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
    engine.model = spec.compile()
    engine.data = mujoco.MjData(engine.model)
    return engine
