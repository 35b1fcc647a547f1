"""MuJoCo's C engine with boxes that move, of tests in several files."""

import mujoco
import numpy as np

from gnnjax.scene.mujoco_world import build_world, obstacles, place_obstacles

MARGIN = 1e-3  # m; the C engine reports contacts this far apart, too


class Engine:
    """MuJoCo's C engine: one world, whose boxes move from scene to scene."""

    def __init__(self, robot, max_obstacles=10, margin=MARGIN):
        self.model = build_world(robot, max_obstacles)
        self.model.geom_margin[:] = margin
        self.model.body_margin[:] = margin
        self.data = mujoco.MjData(self.model)
        self.boxes = obstacles(self.model, max_obstacles).geoms

    def place(self, scene):
        place_obstacles(self.model, self.data, scene)

    def move(self, q):
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def gap(self, q):
        """Least contact distance, m; `MARGIN` or more without contacts."""
        self.move(q)
        mujoco.mj_collision(self.model, self.data)
        return min(self.data.contact.dist[: self.data.ncon], default=np.inf)

    def gaps(self, q):
        return np.array([self.gap(row) for row in np.asarray(q, float)])

    def box_distance(self, geom, box):
        other = int(self.boxes[box])
        return mujoco.mj_geomDistance(self.model, self.data, geom, other, 10.0, None)

    def clearance(self, robot, scene, q):
        """Least true distance, pair by pair, m."""
        self.move(np.asarray(q, float))
        weld = self.model.body_weldid[self.model.geom_bodyid]
        moving = [g for g in robot.sphere_geoms.tolist() if weld[g]]
        found = [self.box_distance(g, i) for g in moving for i in np.flatnonzero(scene.mask)]
        for i, j in robot.sphere_geoms[robot.sphere_pairs].tolist():
            found.append(mujoco.mj_geomDistance(self.model, self.data, i, j, 10.0, None))
        return min(found)
