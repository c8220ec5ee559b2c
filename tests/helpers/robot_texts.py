"""Model files of small robots that have something of everything, and how they are read."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import mujoco

from frictionzoo.bench.robot_file import RobotFile, read_robot

LEG = """<mujoco model="leg"><compiler angle="degree"/><option timestep="0.004" gravity="0 1 -9.7"/>
<default><joint damping="0.3" frictionloss="0.2"/>
<default class="knee"><joint axis="0 1 0.1" armature="0.03"/></default></default>
<asset><mesh name="shell" file="not/there.stl"/><texture name="t" type="2d" file="no.png"/>
<material name="m" texture="t"/><hfield name="hills" file="no.png" size="1 1 1 1"/></asset>
<worldbody><geom type="hfield" hfield="hills"/><body name="trunk" pos="0 0 0.7" euler="10 20 0"><freejoint name="root"/>
<geom type="mesh" mesh="shell" material="m"/><site name="imu" material="m"/>
<frame euler="0 0 30"><body name="thigh" pos="0.1 0 0" euler="0 40 0">
<joint name="hip" axis="1 0.2 0" range="-40 90" ref="7"/><geom type="capsule" size="0.03 0.1" density="400"/>
<geom type="mesh" mesh="shell" mass="0" contype="0" conaffinity="0"/>
<body name="pad" pos="0.02 0 0" quat="1 0.2 0 0"><geom type="box" size="0.03 0.02 0.01"/></body>
<body name="shin" pos="0 0 -0.2"><joint name="knee" class="knee" stiffness="4" springref="20" pos="0.01 0 0"/>
<inertial pos="0 0.01 -0.1" mass="0.4" fullinertia="0.004 0.005 0.003 0.0002 -0.0003 0.0001"/>
<geom type="mesh" mesh="shell"/>
<body name="foot" pos="0 0 -0.2" gravcomp="0.5"><geom size="0.02" mass="0.05"/>
<body name="toe"><joint name="toe" axis="0 1 0" ref="15"/><geom size="0.01" mass="0.02" pos="0.03 0 0"/></body></body>
</body></body></frame></body></worldbody>
<sensor><accelerometer site="imu"/></sensor><keyframe><key qpos="0 0 1 1 0 0 0 0 0 0"/></keyframe>
<actuator><motor name="hip" joint="hip" gear="6" ctrlrange="-2 2" forcerange="-1.5 1" armature="0.001" damping="0.002"/>
<position name="knee" joint="knee" kp="30" kv="0.4" gear="-1"/>
<velocity name="toe" joint="toe" kv="1"/></actuator></mujoco>"""
ARM = """<robot name="arm"><link name="base"><visual><geometry><mesh filename="package://arm/base.dae"/></geometry></visual>
<collision><geometry><mesh filename="package://arm/base.dae"/></geometry></collision></link>
<link name="upper"><inertial><origin xyz="0 0.1 0.2" rpy="0.1 0.2 0.3"/><mass value="2"/>
<inertia ixx="0.02" iyy="0.021" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="package://arm/upper.stl"/></geometry></collision></link>
<link name="lower"><inertial><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tool"><inertial><origin xyz="0 0 0.1"/><mass value="0.3"/>
<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><origin xyz="0 0 0.3" rpy="0 0.1 0"/><origin xyz="9 9 9"/><parent link="base"/>
<child link="upper"/><axis xyz="0 1 0"/><limit effort="40" lower="-2" upper="1" velocity="3"/>
<dynamics damping="0.7" friction="0.4"/></joint>
<joint name="elbow" type="continuous"><origin xyz="0 0 0.4"/><parent link="upper"/>
<child link="lower"/><axis xyz="0 1 1"/></joint>
<joint name="flange" type="fixed"><origin xyz="0 0 0.3" rpy="1 0 0"/><parent link="lower"/><child link="tool"/></joint>
<transmission name="t1"/><gazebo reference="upper"/></robot>"""
FINGERS = """<link name="{0}"><inertial><mass value="0.1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}" type="prismatic"><parent link="tool"/><child link="{0}"/><axis xyz="0 1 0"/>
<limit effort="9" lower="0" upper="0.1" velocity="1"/>{1}</joint>"""
GRIPPER = ARM.replace(
    "</robot>",
    FINGERS.format("left", "")
    + FINGERS.format("right", '<mimic joint="left" multiplier="-1" offset="0.01"/>')
    + "</robot>",
)
TENDON = """<tendon><fixed name="t" stiffness="9" damping="0.1" springlength="0.3"><joint joint="hip" coef="2"/>
<joint joint="toe" coef="-1"/></fixed></tendon>"""
TWO = """<body name="tip" pos="0 0 0.2"><joint name="tip" axis="0 1 0"/>
<inertial pos="0 0 0.1" mass="1" diaginertia="1 1 1"/></body>"""


def save(folder: Path, text: str) -> str:
    path = folder / ("robot.urdf" if text.startswith("<robot") else "robot.xml")
    path.write_text(text)
    return str(path)


def read(folder: Path, text: str, joint: Any = None, **options: Any) -> RobotFile:
    return read_robot(save(folder, text), joint, **options)


def compiled(robot: RobotFile) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ET.tostring(robot.root, encoding="unicode"))


def body(inside: str, outside: str = "") -> str:
    """An MJCF of one link on a hinge."""
    inertial = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.02 0.02 0.01"/>'
    link = f'<body name="link"><joint name="hinge" axis="0 1 0"/>{inertial}{inside}</body>'
    return f"<mujoco><worldbody>{link}</worldbody>{outside}</mujoco>"


def changed(text: str, *pairs: tuple[str, str]) -> str:
    """The text with each first of a pair replaced by its second."""
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return text
