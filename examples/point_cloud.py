"""Plans around a shelf that only a depth camera has seen.

python examples/point_cloud.py
"""

import mujoco
import numpy as np

import gnnjax

SHELF = """<mujoco>
  <worldbody>
    <geom type="box" size="0.15 0.4 0.01" pos="0.65 0 0.3"/>
    <geom type="box" size="0.15 0.4 0.01" pos="0.65 0 0.75"/>
    <geom type="box" size="0.15 0.01 0.5" pos="0.65 0 0.5"/>
    <camera name="eye" pos="-0.3 0 1.3" xyaxes="0 -1 0 0.6 0 0.8" fovy="70"/>
  </worldbody>
</mujoco>"""

# The camera casts a ray a pixel; a real one gives an image of depths.
model = mujoco.MjModel.from_xml_string(SHELF)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
eye, turn = data.cam_xpos[0], data.cam_xmat[0].reshape(3, 3)
x, y = np.meshgrid(np.linspace(-0.9, 0.9, 240), np.linspace(-0.7, 0.7, 180))
rays = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ turn.T
rays /= np.linalg.norm(rays, axis=1, keepdims=True)
depth, seen = np.empty(len(rays)), np.empty(len(rays), np.int32)
mujoco.mj_multiRay(model, data, eye, rays.ravel(), None, 1, -1, seen, depth, None, len(rays), 10)
points = (eye + depth[:, None] * rays)[seen >= 0]

# Points a centimetre apart or less are joined; what the camera does not see is free.
scene = gnnjax.scene_from_points(points, radius=0.01, voxel=0.01)
planner = gnnjax.load_planner("kuka_iiwa14")
plan = planner.plan(scene, [-0.9, 0.9, 0, -1, 0, 0.6, 0], [0.9, 0.9, 0, -1, 0, 0.6, 0])
print(
    f"{len(points)} points, cost {plan.cost:.2f} rad, {plan.configuration_checks} checks, "
    f"certified: {plan.certified}"
)
