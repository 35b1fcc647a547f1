"""Plans around a shelf that only a depth camera has seen, which sees the arm, too.

python examples/point_cloud.py
"""

import mujoco
import numpy as np

import gnnjax

planner = gnnjax.load_planner("kuka_iiwa14")
start, goal = [-0.9, 0.9, 0, -1, 0, 0.6, 0], [0.9, 0.9, 0, -1, 0, 0.6, 0]

spec = planner.robot.mj_spec.copy()
for pos, size in (
    ([0.65, 0, 0.3], [0.15, 0.4, 0.01]),
    ([0.65, 0, 0.75], [0.15, 0.4, 0.01]),
    ([0.65, 0, 0.5], [0.15, 0.01, 0.5]),
):
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=size)
# The camera casts a ray a pixel; a real one gives an image of depths.
model = spec.compile()
data = mujoco.MjData(model)
data.qpos[:] = start
mujoco.mj_forward(model, data)
eye = np.array([-0.3, 0, 1.3])
turn = np.array([[0, -1, 0], [0.6, 0, 0.8], [-0.8, 0, 0.6]])  # right, up, backwards
x, y = np.meshgrid(np.linspace(-0.9, 0.9, 240), np.linspace(-0.7, 0.7, 180))
rays = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ turn
rays /= np.linalg.norm(rays, axis=1, keepdims=True)
depth, seen = np.empty(len(rays)), np.empty(len(rays), np.int32)
mujoco.mj_multiRay(model, data, eye, rays.ravel(), None, 1, -1, seen, depth, None, len(rays), 10)
points = (eye + depth[:, None] * rays)[seen >= 0]

# Those on the arm itself go; points a centimetre apart or less are joined; what the camera does not
# see is free.
others = gnnjax.without_robot(points, planner.robot, start)
scene = gnnjax.scene_from_points(others, radius=0.01, voxel=0.01)
plan = planner.plan(scene, start, goal)
print(
    f"{len(others)} of {len(points)} points, cost {plan.cost:.2f} rad, "
    f"{plan.configuration_checks} checks, certified: {plan.certified}"
)
