"""Signals and joints of common messages: which field is which signal, and which motor is which joint."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from frictionzoo.data.pairing import find_name
from frictionzoo.data.recording import Table

_MOTOR_STATE = {"q": "qpos", "dq": "qvel", "tau_est": "effort"}
_MOTOR_COMMAND = {"q": "ctrl", "dq": "ctrl_velocity", "tau": "ctrl_torque", "kp": "kp", "kd": "kd"}
_OLD_STATE = {"q": "qpos", "dq": "qvel", "tauEst": "effort"}
_OLD_COMMAND = {"q": "ctrl", "dq": "ctrl_velocity", "tau": "ctrl_torque", "Kp": "kp", "Kd": "kd"}
_POINT = {"positions": "qpos", "velocities": "qvel", "effort": "effort"}
_DESIRED = {"positions": "ctrl", "velocities": "ctrl_velocity"}


def _under(parent: str, fields: Mapping[str, str]) -> dict[str, str]:
    return {f"{parent}/{field}": signal for field, signal in fields.items()}


SIGNALS: Mapping[str, Mapping[str, str]] = {
    "LowState": {**_under("motor_state", _MOTOR_STATE), **_under("motorState", _OLD_STATE)},
    "HandState": _under("motor_state", _MOTOR_STATE),
    "MotorStates": _under("states", _MOTOR_STATE),
    "LowCmd": {**_under("motor_cmd", _MOTOR_COMMAND), **_under("motorCmd", _OLD_COMMAND)},
    "HandCmd": _under("motor_cmd", _MOTOR_COMMAND),
    "MotorCmds": _under("cmds", _MOTOR_COMMAND),
    "JointTrajectoryControllerState": {
        **_under("feedback", _POINT),
        **_under("actual", _POINT),
        **_under("reference", _DESIRED),
        **_under("desired", _DESIRED),
    },
}
"""Signal of each field, without numbers of entries, by message type; other fields of these types are no signals.

`effort` is a torque or force, commanded or measured.
"""

_LEGS = ("hip", "thigh", "calf")
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
_G1_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_WRIST = ("wrist_roll", "wrist_pitch", "wrist_yaw")


def _sides(parts: Sequence[str], *sides: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for side in sides for part in parts)


_QUADRUPED = _sides(_LEGS, "FR", "FL", "RR", "RL")
MOTORS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "unitree_legged_msgs": {"A1 and Go1": _QUADRUPED},
    "unitree_go": {
        "Go2": _QUADRUPED,
        "H1": (
            *("right_hip_roll", "right_hip_pitch", "right_knee", "left_hip_roll", "left_hip_pitch", "left_knee"),
            *("torso", "left_hip_yaw", "right_hip_yaw", "unused", "left_ankle", "right_ankle"),
            *_sides(_ARM, "right", "left"),
        ),
    },
    "unitree_hg": {
        "G1": (
            *_sides(_G1_LEG, "left", "right"),
            *("waist_yaw", "waist_roll", "waist_pitch"),
            *_sides((*_ARM, *_WRIST), "left", "right"),
        ),
        "H1-2": (
            *_sides(("hip_yaw", "hip_pitch", "hip_roll", "knee", "ankle_pitch", "ankle_roll"), "left", "right"),
            *("torso", *_sides((*_ARM, *_WRIST), "left", "right")),
        ),
    },
}
"""Joints in the order of the motors, by package of the messages and robot."""


def find_preset(kind: str) -> Mapping[str, str] | None:
    """Return the signals of a message type such as `unitree_hg/msg/LowState`, or None if no preset has it."""
    package, _, name = kind.partition("/msg/")
    return SIGNALS.get(name) if package in MOTORS or package == "control_msgs" else None


def name_motors(table: Table, joints: Sequence[str]) -> tuple[Table, str]:
    """Replace numbers of motors in headers by the names of joints, if one robot of the maker has all these joints.

    Return the table, and a sentence for the log; empty if nothing was replaced.
    """
    packages = sorted({*table.motors.values()})
    if not joints or len(packages) != 1:
        return table, ""
    # A missing motor is at exactly 0.
    last = max((_motor(header) for header in table.motors if np.any(table.columns[header])), default=0)
    found: dict[tuple[int, ...], tuple[str, tuple[str, ...]]] = {}
    for robot, order in MOTORS[packages[0]].items():
        names = [find_name(name, tuple(joints)) for name in order]
        motors = {name.joint: motor for motor, name in enumerate(names) if name is not None}
        if len(motors) == len(joints) and last < len(order):
            found.setdefault(tuple(motors[joint] for joint in range(len(joints))), (robot, order))
    if len(found) != 1:
        robots = " and ".join(robot for robot, _ in found.values()) or "no known robot"
        return table, f"motors are numbered, and {robots} of {packages[0]} may have these joints; set data.columns"
    ((robot, order),) = found.values()

    def name_joint(header: str) -> str:
        is_named = header in table.motors and _motor(header) < len(order)
        return _NUMBER.sub(f"[{order[_motor(header)]}]", header, count=1) if is_named else header

    changed = {
        part: {name_joint(header): value for header, value in getattr(table, part).items()}
        for part in ("columns", "times", "units", "signals", "refused")
    }
    return replace(table, **changed, motors={}), f"motors named by their numbers on the {robot} ({packages[0]})"


_NUMBER = re.compile(r"\[(\d+)\]")


def _motor(header: str) -> int:
    match = _NUMBER.search(header)
    return int(match.group(1)) if match else 0
