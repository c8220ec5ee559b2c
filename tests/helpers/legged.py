"""Robots with legs."""

from collections.abc import Callable
from typing import Any

import pytest

import frictionzoo as fz
from frictionzoo.bench import Bench, PositionPD


def limb(name: str, side: float, joints: int) -> str:
    inner = f"""<body pos="0 {0.05 * side} -0.2"><joint name="{name}_knee" axis="0 1 0"/>
      <inertial pos="0.01 {0.02 * side} -0.1" mass="0.4" diaginertia="0.003 0.002 0.001" quat="1 {0.1 * side} 0 0"/>
    </body>"""
    return f"""<body pos="0.2 {0.1 * side} 0.5"><joint name="{name}_hip" axis="{side} 0 0" damping="0.02"/>
      <inertial pos="0 {0.03 * side} -0.1" mass="1" diaginertia="0.01 0.01 0.005"/>{inner if joints > 1 else ""}
    </body>"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Bench]:
    """Two mirrored legs and a tail of one joint, all on a base that is fixed, from arguments of `Bench`."""
    path = tmp_path_factory.mktemp("robot") / "robot.xml"
    limbs = limb("left", 1.0, 2) + limb("tail", 0.5, 1) + limb("right", -1.0, 2)
    path.write_text(
        f'<mujoco><option timestep="0.002"/><worldbody><body name="base">{limbs}</body></worldbody></mujoco>'
    )
    joints = ["left_hip", "left_knee", "tail_hip", "right_hip", "right_knee"]
    pd = PositionPD(kp=[20, 40, 10, 20, 40], kd=[0.5, 1, 0.3, 0.5, 1])
    return lambda **more: Bench(str(path), joints, actuator=pd, **more)


LEG = """<body name="{0}_hip" pos="0 {1} 0"><joint name="{0}_hip_joint" class="leg" axis="1 0 0" range="-1 1"/>
  <inertial pos="0 0 -0.02" mass="0.5" diaginertia="0.002 0.002 0.001"/><geom type="mesh" mesh="hip"/>
  <body name="{0}_calf" pos="0 0 -0.2"><joint name="{0}_calf_joint" class="leg" axis="0 1 0" armature="0.03"/>
    <inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.0001"/><geom size="0.02" pos="0 0 -0.2"/></body>
</body>"""
DOG = """<mujoco><compiler angle="radian"/><option timestep="0.002"/>
  <default><default class="leg"><joint armature="0.02" damping="0.1" frictionloss="0.2"/></default></default>
  <asset><mesh name="hip" file="hip.obj"/></asset>
  <worldbody><body name="trunk" pos="0 0 1"><freejoint/><inertial pos="0 0 0" mass="5" diaginertia="0.1 0.1 0.1"/>
  {left}{right}<body name="head"><joint name="neck" axis="0 0 1"/>
  <inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.01 0.01"/></body></body></worldbody>
  <actuator>{actuators}</actuator></mujoco>"""
JOINTS = ("left_hip_joint", "left_calf_joint", "right_hip_joint", "right_calf_joint")
POSITION = '<position name="{0}" joint="{0}" kp="{1}" kv="{2}" forcerange="-9 9"/>'
GAINS = {"hip": (20, 0.5), "calf": (40, 1.0)}


def position(name: str) -> str:
    return POSITION.format(name, *GAINS[name.split("_")[1]])


@pytest.fixture(scope="module")
def dog(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., fz.Robot]:
    """A dog with two legs and a head, its meshes missing, from how an actuator is written and arguments of `Robot`."""
    folder = tmp_path_factory.mktemp("dog")

    def dog(write: Callable[[str], str] = position, joint: Any = ".*_(hip|calf)_joint", **more: Any) -> fz.Robot:
        path = folder / f"{abs(hash(write(JOINTS[0])))}.xml"
        legs = {"left": LEG.format("left", 0.1), "right": LEG.format("right", -0.1)}
        path.write_text(DOG.format(**legs, actuators="".join(map(write, JOINTS))))
        return fz.Robot(str(path), joint, **more)

    return dog
