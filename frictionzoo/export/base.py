"""The interface of an export target: what it writes, how exact that is, and what it cannot represent."""

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
from frictionzoo.result.identified import Identified
from frictionzoo.result.simulator import find_errors


class Target(ABC):
    """One kind of files that another program reads.

    Attributes:
        name: Set by `register_target`.
        options: What it takes besides `timestep` and `output`: name to meaning, in a few words.
        integrators: MuJoCo's integrators that it can be written for.
        packages: Python packages without which it can be neither written nor run; their versions are noted.
        instant: Whether it writes the law itself as a function of one instant, which a law with a memory is not.
    """

    name: ClassVar[str]
    options: ClassVar[Mapping[str, str]] = {}
    integrators: ClassVar[Sequence[str]] = tuple(INTEGRATORS.values())
    packages: ClassVar[tuple[str, ...]] = ()
    instant: ClassVar[bool] = False

    @abstractmethod
    def write(self, fitted: Identified, folder: Path, options: Mapping[str, str]) -> Export:
        """Write the drive, and run what was written.

        Args:
            fitted: The drive, at the time step that was asked for.
            folder: An empty folder; whatever goes wrong, nothing of it is left to the user.
            options: Those of `options` that were given, as text.

        Raises:
            FrictionzooError: The target cannot hold this drive at all, or an option makes no sense.
        """


REGISTRY = Registry(KINDS["targets"], Target, "write", ExportError)

register_target = REGISTRY.register
"""Class decorator that makes a target available on the command line, as `Registry.register`."""

get_target: Callable[[str], type[Target]] = REGISTRY.get
"""The target of that name, as `Registry.get`."""

target_names: Callable[[], list[str]] = REGISTRY.names
"""Names of all targets, sorted."""


def measure(
    quantity: str,
    fitted: Identified,
    came: Float[np.ndarray, "*shape"],
    expected: Float[np.ndarray, "*shape"],
    over: str | None = None,
    reason: str = "",
) -> Difference:
    """Measure the difference of the written files from the fitted drive.

    Args:
        quantity: `qpos` or `torque`.
        fitted: The drive.
        came: Values of the written files; positions of all long test rollouts are compared with the recordings too.
        expected: Values of the drive.
        over: The compared data, in words; None for the long test rollouts.
        reason: What the target lacks of the drive, in a few words.
    """
    distance, positions = np.abs(came - expected), quantity == "qpos"
    whole = positions and over is None
    error = float(np.abs(find_errors(fitted, came)).mean()) if whole else None
    unit = UNITS[fitted.bench.joint_type]["position" if positions else quantity]
    return Difference(quantity, unit, float(distance.max()), float(distance.mean()), over or fitted.over, reason, error)


def match_joint(name: str) -> str:
    """Write a regular expression that matches the whole name of this joint and no other name."""
    return f"^{re.escape(name)}$"


def list_values(values: Float[np.ndarray, "nv"]) -> str:
    """Numbers of the joints for a line, one number where all are the same."""
    return f"{values[0]:.4g}" if (values == values[0]).all() else ", ".join(f"{value:.4g}" for value in values)


def read_number(options: Mapping[str, Any], name: str) -> float | None:
    """An option as a number; None where it was not given.

    Raises:
        ConfigError: It is not a finite number.
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
