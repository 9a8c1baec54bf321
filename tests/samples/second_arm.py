"""An invented arm that differs from the LWR.

It has a slide, joints away from the origins of their bodies, geoms that are not capsules, and a branch that does not
move the camera.
"""

MJCF = """
<mujoco model="second">
  <compiler angle="radian" autolimits="true"/>
  <default>
    <joint armature="0.1"/>
  </default>
  <worldbody>
    <body name="pedestal" pos="0.02 0 0.05" euler="0.1 0 0">
      <geom type="cylinder" size="0.05 0.05"/>
      <body name="carriage" pos="0 0 0.1">
        <joint name="rail" type="slide" axis="1 0 0.2" range="-0.3 0.3" ref="0.05"/>
        <geom type="box" size="0.06 0.04 0.03" mass="1"/>
        <body name="upper" pos="0 0 0.1" quat="0.9 0.1 0.2 0">
          <joint name="yaw" axis="0 0 1" pos="0.02 0.01 0" range="-3 3"/>
          <joint name="pitch" axis="0 1 0" pos="0 0 0.03" range="-2 2" ref="0.3"/>
          <geom type="capsule" size="0.03" fromto="0 0 0.05 0 0 0.35" mass="1"/>
          <body name="lever" pos="0 0.1 0.1">
            <joint name="lever" axis="0 1 1"/>
            <geom type="sphere" size="0.02" mass="0.1"/>
          </body>
          <body name="lower" pos="0 0 0.4">
            <joint name="elbow" axis="0 1 0" range="-2.4 2.4"/>
            <geom type="capsule" size="0.03" fromto="0 0 0.05 0 0 0.3" mass="1"/>
            <body name="wrist" pos="0 0 0.35">
              <joint name="roll" axis="0 0 1" range="-3 3"/>
              <joint name="tilt" axis="1 0 0" range="-2 2"/>
              <joint name="turn" axis="0 0 1" range="-3 3"/>
              <geom type="ellipsoid" size="0.03 0.04 0.03" mass="0.3"/>
              <site name="tcp" pos="0 0 0.1"/>
              <camera name="wrist" pos="0.01 0 0.1" quat="0 1 0 0"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
