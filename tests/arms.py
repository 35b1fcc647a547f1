"""Arms of tests in several files, as MJCF."""

# Skew axes, anchors off the origin, a reference angle, a slide joint and several joints on a body.
ODD = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body pos="0.1 -0.2 0.3" quat="0.6 0.1 -0.7 0.2">
      <joint axis="1 2 -0.5" pos="0.05 -0.03 0.2" range="-3 3"/>
      <geom type="sphere" size="0.05" contype="1" conaffinity="1" mass="1"/>
      <body pos="0 0 0.4" quat="1 0 0 1">
        <joint type="slide" axis="0.3 0 1" range="-0.4 0.5" ref="0.1"/>
        <joint axis="0 0 -1" pos="0.1 0 0" range="-2 2" ref="0.7"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0.2 0 0.1" mass="1"/>
        <body pos="0.2 0 0" quat="0 1 0 0">
          <body pos="0 0.3 0">
            <joint axis="0 -0.6 0.8" pos="0 0 -0.1" range="-2 2" ref="-0.4"/>
            <geom type="sphere" size="0.06" pos="0.1 0 0" mass="1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

# Armature, damping, a spring, a body whose weight is compensated, gravity that is askew.
HEAVY = (
    ODD.replace("<mujoco>", '<mujoco><option gravity="1 -2 -9"/>', 1)
    .replace(
        'range="-3 3"', 'range="-3 3" armature="0.3" damping="2" stiffness="5" springref="0.4"'
    )
    .replace('<body pos="0.2 0 0"', '<body gravcomp="0.7" pos="0.2 0 0"')
    .replace('fromto="0 0 0 0.2 0 0.1" mass="1"', 'fromto="0 0 0 0.2 0 0.1" mass="3"')
)

# Links of all kinds that are no spheres, and two that can reach the first.
CRANE = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom contype="1" conaffinity="1" mass="1"/></default>
  <asset>
    <mesh name="wedge" vertex="0 -.04 -.05 .25 -.04 -.02 .25 .04 -.02 0 .04 -.05 0 0 .06"/>
  </asset>
  <worldbody>
    <body name="foot">
      <geom type="box" size="0.08 0.08 0.05"/>
      <body name="mast" pos="0 0 0.06">
        <joint axis="0 0 1" range="-3 3"/>
        <geom type="cylinder" fromto="0 0 0 0 0 0.35" size="0.05"/>
        <body name="boom" pos="0 0 0.4">
          <joint axis="0 1 0" range="-2.5 2.5"/>
          <geom type="box" pos="0.15 0 0" size="0.15 0.03 0.04"/>
          <body name="jib" pos="0.33 0 0">
            <joint axis="0 0 1" range="-2.8 2.8"/>
            <geom type="mesh" mesh="wedge"/>
            <body name="tip" pos="0.28 0 0">
              <joint axis="0 1 0" range="-2.5 2.5"/>
              <geom type="capsule" fromto="0.03 0 0 0.15 0 0" size="0.03"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

CAPSULES = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom contype="1" conaffinity="1" mass="1"/></default>
  <worldbody>
    <geom type="capsule" fromto="0 0 -0.2 0 0 0" size="0.06"/>
    <body pos="0 0 0.1">
      <joint axis="0 0 1" range="-3 3"/>
      <geom type="capsule" fromto="0 0 0.1 0.1 0 0.4" size="0.05"/>
      <body pos="0.1 0 0.45">
        <joint axis="0 1 0" range="-2.6 2.6"/>
        <geom type="sphere" pos="0 0.04 0.15" size="0.06"/>
        <body pos="0 0 0.3">
          <joint axis="0.6 0.8 0" range="-2.6 2.6"/>
          <geom type="capsule" fromto="0 0 0.05 0.05 0 0.3" size="0.04"/>
          <body pos="0.05 0 0.35">
            <joint axis="0 1 0" range="-2.6 2.6"/>
            <geom type="capsule" fromto="-0.1 0 0.12 0.15 0.02 0.14" size="0.03"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

# Parts of all kinds that meet themselves: past a joint of more than a turn, past a slide that has a
# reference, on two branches, and two that never meet.
FOLDING = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom contype="1" conaffinity="1" mass="1"/></default>
  <asset>
    <mesh name="wedge" vertex="0 -.04 -.05 .2 -.04 -.02 .2 .04 -.02 0 .04 -.05 0 0 .06"/>
  </asset>
  <worldbody>
    <body name="foot">
      <geom type="box" size="0.15 0.06 0.05"/>
      <body name="post" pos="0 0 0.06">
        <joint axis="0 0 1" range="-6 6"/>
        <geom type="cylinder" fromto="0 0 0 0 0 0.1" size="0.04"/>
        <body name="arm" pos="0.06 0 0.12" quat="0.98 0.1 0 0.1">
          <joint axis="0 1 0" pos="0.01 0 0" range="-2.7 2.7"/>
          <geom type="box" pos="0.1 0 0" size="0.1 0.03 0.02"/>
          <body name="slide" pos="0.22 0.05 0.03">
            <joint type="slide" axis="1 0.2 0" range="-0.3 0.1" ref="-0.05"/>
            <geom type="capsule" fromto="0 0 0.02 0 0 0.1" size="0.02"/>
            <body name="tip" pos="0 0 0.14">
              <joint axis="0 1 0.3" range="-2.9 2.9"/>
              <geom type="mesh" mesh="wedge"/>
            </body>
          </body>
        </body>
        <body name="branch" pos="-0.05 0.05 0.15">
          <joint axis="0 0 1" range="-2 2"/>
          <geom type="ellipsoid" pos="0 0.12 0" size="0.03 0.1 0.03"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
