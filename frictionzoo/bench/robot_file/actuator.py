"""An actuator of a robot's file, as its joint feels it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class Command(NamedTuple):
    """A command of the file's actuators, as a recording has it: signal = factor * command.

    Attributes:
        index: Among `MjData.ctrl` of the file.
        signal: `ctrl`, `ctrl_velocity` or `ctrl_torque`.
        factor: In joint space; the gear is in it.
    """

    index: int
    signal: str
    factor: float


@dataclass(frozen=True)
class ReadActuator:
    """An actuator as the file has it, in joint space: torque = gain ctrl + bias0 + bias1 qpos + bias2 qvel.

    Attributes:
        name: In the file, or its number; of several that are one controller all of them.
        kind: `motor`, `position` with or without velocity and torque commands, `velocity` by what its law comes down
            to, or `general`.
        gain: Factor of the first command; the gear is in it.
        bias0: Constant torque [N m or N].
        bias1: Factor of the position.
        bias2: Factor of the velocity.
        gear: As in the file.
        ctrlrange: Ends of the first command's range, in the command's unit; NaN where it has none.
        forcerange: Ends of the torque's range at the joint [N m or N]; NaN where it has none.
        delay: By which commands act late in MuJoCo's steps [s].
        commands: What recordings call its commands; the first is `ctrl`.
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
        """Ends of the range of what it gives [N m or N], of a motor by its command's range too."""
        low, high = self.forcerange
        if self.kind != "motor":
            return low, high
        ends = np.sort(self.gain * np.array(self.ctrlrange))
        return clip_range((float(ends[0]), float(ends[1])), self.forcerange)

    @property
    def positions(self) -> tuple[float, float]:
        """Ends of the range of desired positions [rad or m]; NaN where there is none or none is desired."""
        if self.kind != "position":
            return np.nan, np.nan
        low, high = np.sort(np.array(self.ctrlrange) / self.gear)
        return float(low), float(high)


def clip_range(inner: tuple[float, float], outer: tuple[float, float]) -> tuple[float, float]:
    """Ends of what is cut off at `inner` and then at `outer`; NaN is no end."""
    if np.isnan(inner).any() or np.isnan(outer).any():
        return outer if np.isnan(inner).any() else inner
    low, high = np.clip(inner, *outer)
    return float(low), float(high)
