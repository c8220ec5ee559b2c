"""Interface of an export target: files, their accuracy, and their limits."""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.template import INTEGRATORS
from frictionzoo.core.errors import ConfigError, ExportError
from frictionzoo.core.params import UNITS
from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.export.written import Difference, Export
from frictionzoo.result.fitted_drive import FittedDrive


class Target(ABC):
    """Export target: files for another program.

    Attributes:
        name: Set by `register_target`.
        options: Options of the target, with a short description each, in addition to the common ones.
        integrators: MuJoCo integrators that the target supports.
        packages: Python packages needed to write and run the files; their versions are noted.
        instant: Whether the files hold the friction model as a function of one instant, which excludes models with
            memory.
    """

    name: ClassVar[str]
    options: ClassVar[Mapping[str, str]] = {}
    integrators: ClassVar[Sequence[str]] = tuple(INTEGRATORS.values())
    packages: ClassVar[tuple[str, ...]] = ()
    instant: ClassVar[bool] = False

    @abstractmethod
    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """Write the drive, and run the written files.

        Args:
            fitted: The drive, for the requested time step.
            folder: An empty folder; its files are discarded after an error.
            options: The given options of the target, as text.

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
) -> Difference:
    """Measure the difference between the written files and the fitted drive.

    Args:
        quantity: `qpos` or `torque`.
        fitted: The drive.
        came: Values of the written files; positions of all long test rollouts are also compared with the recordings.
        expected: Values of the drive.
        over: The compared data, in words; None for the long test rollouts.
        reason: Reason for a difference, in a few words.
    """
    distance, positions = np.abs(came - expected), quantity == "qpos"
    whole = positions and over is None
    error = float(np.abs(fitted.find_errors(came)).mean()) if whole else None
    unit = UNITS[fitted.bench.joint_type]["position" if positions else quantity]
    return Difference(quantity, unit, float(distance.max()), float(distance.mean()), over or fitted.over, reason, error)


def match_joint(name: str) -> str:
    """Return a regular expression that matches only this joint name."""
    return f"^{re.escape(name)}$"


def list_values(values: Float[np.ndarray, "nv"]) -> str:
    """Format one value for each joint, or a single one if all are equal."""
    return f"{values[0]:.4g}" if (values == values[0]).all() else ", ".join(f"{value:.4g}" for value in values)


def read_number(options: Mapping[str, Any], name: str) -> float | None:
    """Read an option as a number; None if it is not given.

    Raises:
        ConfigError: The option is not a finite number.
    """
    if name not in options:
        return None
    try:
        number = float(options[name])
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise ConfigError(f"{name}={options[name]}; expected a number; change it")
    return number
