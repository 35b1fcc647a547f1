"""Plans for an arm of your own: any MJCF or URDF; nothing has to be trained for it.

python examples/own_arm.py
"""

from pathlib import Path
from tempfile import mkdtemp

import gnnjax

ARM = """<mujoco model="mine">
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 0 1" range="-170 170"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.04"/>
      <body name="fore" pos="0.5 0 0">
        <joint name="elbow" axis="0 0 1" range="-150 150"/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
file = Path(mkdtemp()) / "mine.xml"
file.write_text(ARM, encoding="utf-8")

planner = gnnjax.load_planner(file)
print(
    f"{planner.robot.name}: plans for {planner.robot.joint_names}", *planner.robot.notes, sep="\n"
)
scene = gnnjax.make_scene(centers=[[0.7, 0.0, 0.0]], half_extents=[[0.1, 0.1, 0.1]])
plan = planner.plan(scene, [-1.0, 0.0], [1.0, 0.0])
print(plan.path.round(2), f"certified: {plan.certified}")
