"""Actuator of a robot's file in joint space."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class Command(NamedTuple):
    """Recorded `signal` (`ctrl`, `ctrl_velocity` or `ctrl_torque`) = `factor`, with gear, * `MjData.ctrl[index]`."""

    index: int
    signal: str
    factor: float


@dataclass(frozen=True)
class ReadActuator:
    """Actuator of the file in joint space: torque = gain ctrl + bias0 + bias1 qpos + bias2 qvel.

    Attributes:
        name: Name in the file, or its number; all names if several actuators form one controller.
        kind: `motor`, `position` (with or without velocity and torque commands), `velocity` or `general`.
        gain: Factor of the first command, including the gear.
        ctrlrange: Range of the first command, in the command's unit; NaN without a range.
        forcerange: Torque range at the joint [N m or N]; NaN without a range.
        delay: Delay of the commands in MuJoCo's steps [s].
        commands: Recorded signal of each command; the first is `ctrl`.
    """

    name: str
    kind: str
    gain: float
    bias0: float
    bias1: float
    bias2: float
    gear: float
    ctrlrange: tuple[float, float]
    forcerange: tuple[float, float]
    delay: float
    commands: tuple[Command, ...]

    @property
    def torques(self) -> tuple[float, float]:
        """Torque range [N m or N]; a motor's command range limits it too."""
        low, high = self.forcerange
        if self.kind != "motor":
            return low, high
        ends = np.sort(self.gain * np.array(self.ctrlrange))
        return clip_range((float(ends[0]), float(ends[1])), self.forcerange)

    @property
    def positions(self) -> tuple[float, float]:
        """Range of desired positions [rad or m]; NaN without a range or a position command."""
        if self.kind != "position":
            return np.nan, np.nan
        low, high = np.sort(np.array(self.ctrlrange) / self.gear)
        return float(low), float(high)


def clip_range(inner: tuple[float, float], outer: tuple[float, float]) -> tuple[float, float]:
    """Return the range of a value clipped to `inner` and then to `outer`; NaN is no limit."""
    if np.isnan(inner).any() or np.isnan(outer).any():
        return outer if np.isnan(inner).any() else inner
    low, high = np.clip(inner, *outer)
    return float(low), float(high)
