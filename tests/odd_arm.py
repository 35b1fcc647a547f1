"""An arm whose kinematics leave nothing out."""

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
