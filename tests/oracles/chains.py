"""Serial chains in MJCF that exercise what a robot with neat axes leaves out.

SKEW   skew axes, anchors off the origin, joint references, three joints on one body, fixed child bodies, different
       gravity compensation along the chain; position, motor and velocity actuators with gears, in another order
CRANE  the same with one gravity compensation for all bodies and gravity that is not along z
CART   several slides before the first hinge, and slides after it
"""

from __future__ import annotations

import mujoco

OPTION = """<option integrator="implicitfast"><flag contact="disable" constraint="disable"/></option>"""

SKEW = f"""
<mujoco>
  {OPTION}
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos=".3 -.2 .5" euler="20 -35 50">
      <geom type="box" size=".1 .2 .1"/>
      <body name="a" pos=".1 0 .2" euler="10 20 30">
        <joint name="a" axis="1 2 -1" pos=".05 -.1 .02" armature=".2" damping=".7" ref="25"/>
        <inertial pos=".1 .05 -.02" quat=".9 .1 -.3 .2" mass="2" diaginertia=".02 .03 .04"/>
        <body name="a_fixed" pos=".2 .1 0" euler="0 45 10">
          <inertial pos="0 .1 0" quat=".8 -.1 .3 .2" mass=".7" diaginertia=".002 .004 .003"/>
          <body name="b" pos="0 .3 .1" euler="-40 5 60" gravcomp=".5">
            <joint name="b1" type="slide" axis="0 3 1" ref=".2"/>
            <joint name="b2" axis="1 -1 1" pos="0 .1 .1"/>
            <joint name="b3" axis="0 1 0" pos=".1 0 0"/>
            <inertial pos="0 0 .1" mass="1.1" fullinertia=".03 .02 .025 .001 -.002 .003"/>
            <body name="b_fixed" pos="0 0 .4" euler="90 0 30" gravcomp=".5">
              <geom type="capsule" size=".03 .2"/>
              <site name="tip" pos=".1 .2 .3" euler="15 25 35"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="b1" joint="b1" kp="30" kv="4" gear="-2"/>
    <motor name="a" joint="a" gear="3"/>
    <velocity name="b3" joint="b3" kv="5" gear="1.5"/>
  </actuator>
</mujoco>
"""

CRANE = """
<mujoco>
  <option integrator="implicitfast" gravity="1 -2 -9"><flag contact="disable" constraint="disable"/></option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="trolley" pos="-.1 .4 1" euler="-15 30 70" gravcomp=".4">
      <joint name="travel" type="slide" axis="2 -1 3" armature=".3" damping="1.5"/>
      <inertial pos=".02 -.05 .1" quat=".7 .2 -.4 .1" mass="3" diaginertia=".05 .04 .06"/>
      <body name="boom" pos=".1 .2 -.1" euler="25 -50 5" gravcomp=".4">
        <joint name="slew" axis="-1 1 2" pos=".1 .05 -.2" damping=".3" ref="-40"/>
        <inertial pos=".3 .1 0" mass="1.5" fullinertia=".02 .05 .06 .004 -.003 .002"/>
        <body name="counterweight" pos="-.3 0 .1" euler="0 20 -30" gravcomp=".4">
          <inertial pos="-.1 .02 .03" quat=".5 .5 -.3 .2" mass="2.5" diaginertia=".01 .02 .015"/>
        </body>
        <body name="jib" pos=".6 -.1 .2" euler="60 0 -20" gravcomp=".4">
          <joint name="luff" axis="3 2 1" pos="-.05 .1 .08" armature=".02"/>
          <joint name="reach" type="slide" axis="1 1 -2" damping="2" ref=".1"/>
          <geom type="capsule" size=".03 .25" euler="40 10 0"/>
          <site name="tip" pos=".2 -.1 .4" euler="-25 60 10"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity name="travel" joint="travel" kv="40" gear="-1.5"/>
    <motor name="luff" joint="luff" gear="2"/>
    <position name="reach" joint="reach" kp="60" kv="7"/>
  </actuator>
</mujoco>
"""

CART = f"""
<mujoco>
  {OPTION}
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="rail" pos=".2 0 .3" euler="5 -25 40" gravcomp=".3">
      <joint name="rail" type="slide" axis="1 2 0" armature=".4" damping="3"/>
      <inertial pos="0 .1 -.1" quat=".6 .3 -.2 .7" mass="4" diaginertia=".05 .03 .06"/>
      <body name="cart" pos="-.1 .2 .1" euler="-30 15 20">
        <joint name="cart_1" type="slide" axis="0 1 -2" ref="-.1"/>
        <joint name="cart_2" type="slide" axis="3 1 1" damping="1"/>
        <inertial pos=".05 0 .02" mass="2" fullinertia=".03 .02 .025 .001 -.002 .003"/>
        <body name="mast" pos="0 .1 .2" euler="10 60 -5" gravcomp=".8">
          <joint name="mast" axis="1 -2 2" pos=".02 .1 -.05" damping=".2"/>
          <geom type="capsule" size=".04 .2" pos="0 .05 .2"/>
          <body name="plunger" pos=".1 0 .4" euler="0 35 15" gravcomp="1">
            <joint name="plunger" type="slide" axis="-1 1 4" armature=".1"/>
            <joint name="twist" axis="2 0 1" pos="0 .03 .04"/>
            <geom type="box" size=".05 .1 .02" euler="20 0 10"/>
            <site name="tip" pos="0 .2 .1" euler="40 -10 5"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity name="cart_1" joint="cart_1" kv="20"/>
    <motor name="mast" joint="mast" gear="4"/>
    <position name="plunger" joint="plunger" kp="80" kv="6"/>
  </actuator>
</mujoco>
"""

PENDULUM = """
<mujoco>
  {option}
  <default><geom contype="0" conaffinity="0"/></default>
  {extra}
  <worldbody>
    {world}
    <body name="arm" {body}>
      <joint name="hinge" {joint}/>
      <geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.4" {geom}/>
      <site name="end" pos="0 0 -.4"/>
      {child}
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""


def pendulum(option=OPTION, **parts) -> mujoco.MjModel:
    defaults = dict.fromkeys(("extra", "world", "body", "joint", "geom", "child", "actuator"), "")
    return mujoco.MjModel.from_xml_string(PENDULUM.format(option=option, **(defaults | parts)))
