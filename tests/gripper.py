"""An arm whose two fingers are coupled, for tests in several files."""

import mujoco
import numpy as np

GRIPPER = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom mass="0.1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.3"/>
    <body name="base"><geom type="cylinder" size="0.08 0.05"/>
      <body name="arm" pos="0 0 0.1"><joint name="turn" axis="0 0 1"/>
        <geom type="box" size="0.04 0.04 0.15" pos="0 0 0.15"/>
        <frame pos="0 0 0.3" euler="0.2 0 0">
          <body name="hand" euler="0.1 0.2 0.3">
            <joint name="bend" axis="0 1 0" range="-2 2" actuatorfrcrange="-30 40"/>
            <joint name="slip" type="slide" axis="0 0.6 0.8" range="-0.1 0.1" pos="0.1 0 0"/>
            <geom name="palm" type="ellipsoid" size="0.05 0.03 0.02" pos="0 0 0.06"/>
            <body name="left" pos="0 0.03 0.12">
              <joint name="left" type="slide" axis="0 1 0" range="0 0.04"/>
              <geom name="left" type="capsule" size="0.008 0.02"/>
            </body>
            <body name="right" pos="0 -0.03 0.12">
              <joint name="right" type="slide" axis="0 -1 0" range="0 0.04"/>
              <geom name="right" type="capsule" size="0.008 0.02"/>
            </body>
          </body>
        </frame>
      </body>
    </body>
  </worldbody>
  COUPLING
  <actuator><motor joint="turn" gear="10" forcerange="-5 5"/><motor joint="bend"/>
    <motor joint="slip" forcerange="-7 7"/></actuator>
  <sensor><jointpos joint="left"/></sensor>
  <keyframe><key name="home" qpos="0.1 0.5 0.02 0.03 0.03"/></keyframe>
</mujoco>
"""
EQUALITY = (
    '<equality><joint joint1="right" joint2="left" polycoef="0.005 0.5 0 0 0"/></equality>'
    '<contact><exclude body1="left" body2="right"/></contact>'
)
TENDON = (
    '<tendon><fixed name="grip"><joint joint="left" coef="1"/><joint joint="right" coef="1"/>'
    '</fixed></tendon><equality><tendon tendon1="grip"/></equality>'
)
LOOP = '<equality><connect body1="left" body2="right" anchor="0 0 0"/></equality>'


def written(folder, coupling=EQUALITY, change=lambda text: text):
    path = folder / "gripper.xml"
    path.write_text(change(GRIPPER.replace("COUPLING", coupling)))
    return path


def same_poses(robot, held, prefix=""):
    """Whether geoms are where they are in the whole arm, at random configurations."""
    whole = mujoco.MjModel.from_xml_path(str(robot.path))
    there, here = mujoco.MjData(whole), mujoco.MjData(robot.mj_model)
    rng = np.random.default_rng(0)
    names = [f"{prefix}{name}" for name in ("palm", "left", "right")]
    for _ in range(20):
        q = rng.uniform(robot.joint_lower, robot.joint_upper)
        for name, value in [*held.items(), *zip(robot.joint_names, q, strict=True)]:
            there.joint(name).qpos[:] = value
        here.qpos[:] = q
        mujoco.mj_kinematics(whole, there)
        mujoco.mj_kinematics(robot.mj_model, here)
        for name in names:
            np.testing.assert_allclose(here.geom(name).xpos, there.geom(name).xpos, atol=1e-9)
            np.testing.assert_allclose(here.geom(name).xmat, there.geom(name).xmat, atol=1e-9)
    return True
