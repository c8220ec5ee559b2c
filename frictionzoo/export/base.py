"""Interface of an export target, and its outcome: files, their difference from the drive, and their limits."""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.template import INTEGRATORS
from frictionzoo.core.errors import ConfigError, ExportError, closest, read_number
from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.verdict import FAR


@dataclass(frozen=True)
class Deviation:
    """Absolute difference between the written files, run in their program, and the fitted drive.

    Attributes:
        quantity: `qpos` or `torque`.
        over: The compared data, in words: `10 rollouts of 3 s`.
        reason: Reason for a difference, in a few words; empty if no difference is expected.
        error: Mean absolute position error against the recordings; None if not measured.
    """

    quantity: str
    unit: str
    largest: float
    mean: float
    over: str
    reason: str = ""
    error: float | None = None


@dataclass(frozen=True)
class Export:
    """Files written by a target, their measured differences from the drive, and their limits, a sentence each."""

    files: tuple[str, ...]
    differences: tuple[Deviation, ...]
    limits: tuple[str, ...] = ()


@dataclass(frozen=True)
class Written:
    """Outcome of one target: its `export`, or None and the reason.

    Attributes:
        reason: Reason why nothing was written, in one line.
        error: Mean absolute position error of the drive in the run's test rollouts; None if unknown.
    """

    target: str
    folder: Path | None = None
    export: Export | None = None
    reason: str = ""
    error: float | None = None

    def share(self, difference: Deviation) -> float | None:
        """Return the mean position difference as a share of the drive's error; None if unknown."""
        return difference.mean / self.error if difference.quantity == "qpos" and self.error else None

    def mark(self, difference: Deviation) -> str:
        """Return the mark in a difference's row: empty, or size and reason of a large difference."""
        share = self.share(difference)
        if share is None or share <= FAR:
            return ""
        reason = difference.reason or "for no known reason: do not use it"
        return f"far from the drive, {100 * share:.0f} % of the test error: {reason}"


class Target(ABC):
    """Export target: files for another program.

    Attributes:
        name: Set by `register_target`.
        options: Description of each option of the target, in addition to the common ones.
        integrators: Supported MuJoCo integrators.
        packages: Python packages needed to write and run the files; their versions are noted. With `mujoco`, the
            drive's simulation is also verified against MuJoCo C.
        instant: Whether the files evaluate the friction model at one instant, which excludes models with memory.
    """

    name: ClassVar[str]
    options: ClassVar[Mapping[str, str]] = {}
    integrators: ClassVar[Sequence[str]] = tuple(INTEGRATORS.values())
    packages: ClassVar[tuple[str, ...]] = ()
    instant: ClassVar[bool] = False

    @abstractmethod
    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """Write the drive, and run the written files.

        `fitted` is already converted to the requested time step and to first order; a command delay is left to the
        target. `folder` is empty, and its files are discarded after an error. `options` has the target's options as
        text.

        Raises:
            FrictionzooError: The target cannot represent this drive, or an option is invalid.
        """


REGISTRY = Registry(KINDS["targets"], Target, "write", ExportError)

register_target = REGISTRY.register
"""Class decorator that registers an export target; see `Registry.register`."""

get_target: Callable[[str], type[Target]] = REGISTRY.get
"""Return the target with this name; see `Registry.get`."""

target_names: Callable[[], list[str]] = REGISTRY.names
"""Return the names of all targets, sorted."""


def measure(
    quantity: str,
    fitted: FittedDrive,
    came: Float[np.ndarray, "*shape"],
    expected: Float[np.ndarray, "*shape"],
    over: str | None = None,
    reason: str = "",
) -> Deviation:
    """Measure the difference between `qpos` or `torque` of the written files and of the fitted drive.

    Without `over`, which describes the compared data, these are positions of all long test rollouts, and are also
    compared with the recordings.
    """
    distance, is_position = np.abs(came - expected), quantity == "qpos"
    all_rollouts = is_position and over is None
    error = float(np.abs(fitted.find_errors(came)).mean()) if all_rollouts else None
    unit = fitted.units["position" if is_position else quantity]
    return Deviation(quantity, unit, float(distance.max()), float(distance.mean()), over or fitted.over, reason, error)


def match_joint(name: str) -> str:
    """Return a regular expression that matches only this joint name."""
    return f"^{re.escape(name)}$"


def list_values(values: Float[np.ndarray, "nv"]) -> str:
    """Format one value for each joint, or a single one if all are equal."""
    return f"{values[0]:.4g}" if (values == values[0]).all() else ", ".join(f"{value:.4g}" for value in values)


def read_choice(options: Mapping[str, str], name: str, choices: Collection[str]) -> str:
    """Read an option that is one of these choices; the first one if it is not given.

    Raises:
        ConfigError: There is no such choice.
    """
    chosen = options.get(name, next(iter(choices)))
    if chosen not in choices:
        raise ConfigError(f"{name}={chosen}: unknown; {closest(chosen, choices)}")
    return chosen


def read_optional(options: Mapping[str, Any], name: str) -> float | None:
    """Read an option as a number; None if it is not given.

    Raises:
        ConfigError: The option is not a finite number.
    """
    return read_number(name, options[name]) if name in options else None
