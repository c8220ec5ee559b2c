"""Parameters: value, unit, bounds, and the coordinate in which an optimiser moves them."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictionzoo.core.errors import ConfigError, closest

AT_BOUND = 1e-4
"""Share of the bounds' distance, in the optimiser's coordinate, that counts as reaching a bound."""

_UNITS = {
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "torque": ("N m", "N"),
    "inertia": ("kg m^2", "kg"),
    "damping": ("N m s/rad", "N s/m"),
    "damping/velocity": ("N m s^2/rad^2", "N s^2/m^2"),
    "damping/velocity^2": ("N m s^3/rad^3", "N s^3/m^3"),
    "stiffness": ("N m/rad", "N/m"),
    "1/velocity": ("s/rad", "s/m"),
    "1/position": ("1/rad", "1/m"),
    "1/torque": ("1/(N m)", "1/N"),
    "torque/command": ("N m/(unit of ctrl)", "N/(unit of ctrl)"),
    "torque/voltage": ("N m/V", "N/V"),
    "temperature": ("K", "K"),
    "1/temperature": ("1/K", "1/K"),
    "time": ("s", "s"),
    "1": ("1", "1"),
}
UNITS: dict[str, dict[str, str]] = {
    joint_type: {dimension: units[at] for dimension, units in _UNITS.items()}
    for at, joint_type in enumerate(("hinge", "slide"))
}
"""Unit of each dimension on a hinge (rotation) and on a slide (translation)."""


@dataclass(frozen=True)
class Param:
    """One physical quantity that is either known or identified.

    Attributes:
        name: MuJoCo's or the literature's word.
        dimension: A key of `UNITS`; the unit follows from the joint's type.
        init: Initial value, and the value for good where `identify` is false.
        low: Lower bound.
        high: Upper bound.
        scale: `log`: the optimiser moves the logarithm, so that a step is a share of the value (needs low > 0); or a
            positive number: it moves value / scale, so that a step is a share of that number.
        identify: Whether a fit may change it.

    Raises:
        ConfigError: The bounds are empty, `init` is outside them, or the scale does not fit them.
    """

    name: str
    dimension: str
    init: float
    low: float
    high: float
    scale: str | float
    identify: bool

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ConfigError(f"{self.name}: bounds low={self.low:g}, high={self.high:g}; expected low < high")
        if not self.low <= self.init <= self.high:
            bounds = f"low={self.low:g}, high={self.high:g}"
            raise ConfigError(f"{self.name}: init={self.init:g} lies outside {bounds}; start inside")
        if self.scale == "log" and not self.low > 0:
            raise ConfigError(f"{self.name}: low={self.low:g} with scale=log; expected low > 0, or a number as scale")
        if self.scale != "log" and (isinstance(self.scale, str) or not self.scale > 0):
            raise ConfigError(f"{self.name}: scale={self.scale}; expected log or a positive number")

    @classmethod
    def from_config(cls, name: str, dimension: str, config: Mapping[str, Any]) -> "Param":
        """A parameter from its section of the configuration: `init`, `low`, `high`, `scale`, `identify`, all given.

        Raises:
            ConfigError: A key is missing, unknown or of the wrong type.
        """
        keys = {"init", "low", "high", "scale", "identify"}
        if not isinstance(config, Mapping):
            raise ConfigError(f"{name}={config!r}; expected a number, or a section with {', '.join(sorted(keys))}")
        for key in set(config) - keys:
            raise ConfigError(f"{name}.{key}: unknown option; {closest(str(key), keys)}")
        for key in keys - set(config):
            raise ConfigError(f"{name}.{key}: missing; give {', '.join(sorted(keys))}")
        if not isinstance(config["identify"], bool):
            raise ConfigError(f"{name}.identify={config['identify']}; expected true or false")
        try:
            scale = config["scale"] if config["scale"] == "log" else float(config["scale"])
            init, low, high = (float(config[key]) for key in ("init", "low", "high"))
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{name}: {error}; init, low, high are numbers, scale is log or a number") from None
        return cls(name, dimension, init, low, high, scale, config["identify"])

    def to_coordinate(self, value: Any, xp: Any) -> Any:
        """The optimiser's coordinate of a physical value; `xp` is the array namespace."""
        return xp.log(value) if self.scale == "log" else value / self.scale

    def from_coordinate(self, coordinate: Any, xp: Any) -> Any:
        """The physical value of an optimiser's coordinate; `xp` is the array namespace."""
        return xp.exp(coordinate) if self.scale == "log" else coordinate * self.scale

    def is_at_bound(self, value: Any) -> Any:
        """Whether a physical value, or each one of an array, has reached a bound."""
        at, low, high = (self.to_coordinate(np.asarray(x, np.float64), np) for x in (value, self.low, self.high))
        return np.minimum(at - low, high - at) <= AT_BOUND * (high - low)

    def unit(self, joint_type: str) -> str:
        """Its unit on a `hinge` or a `slide`."""
        return UNITS[joint_type][self.dimension]


def _complete(section: Any, defaults: Mapping[str, Any]) -> Any:
    """A parameter's whole section; of a known value, bounds mean nothing and lie around it."""
    if isinstance(section, (int, float)) and not isinstance(section, bool):
        reach = abs(section) or 1.0
        return {"init": section, "low": section - reach, "high": section + reach, "scale": reach, "identify": False}
    return {**defaults, **section} if isinstance(section, Mapping) else section


def read_params(
    owner: str,
    dimensions: Mapping[str, str],
    config: Mapping[str, Any],
    optional: Collection[str] = (),
    defaults: Mapping[str, Mapping[str, Any]] | None = None,
) -> dict[str, Param]:
    """The parameters that `owner` declares, from the configuration's section of the same names.

    Args:
        owner: Whose they are, for messages.
        dimensions: Dimension of each declared parameter.
        config: Section of each parameter, or its value if that is known.
        optional: Those among them that need no section, and that are left out where they are known to be 0: what they
            stand for is not there.
        defaults: What a section need not say, of each parameter that has such.

    Raises:
        ConfigError: A parameter is missing or unknown.
    """
    for name in set(config) - set(dimensions):
        raise ConfigError(f"{owner}: unknown parameter {name}; {closest(name, dimensions)}")
    config = {**{name: {} for name in defaults or {}}, **config}
    config = {name: _complete(section, (defaults or {}).get(name, {})) for name, section in config.items()}
    for name in set(dimensions) - set(config) - set(optional):
        raise ConfigError(f"{owner}: no parameter {name}; give its value, or params.{name} with init, low, high")
    params = {name: Param.from_config(name, dimensions[name], config[name]) for name in dimensions if name in config}
    return {name: param for name, param in params.items() if param.identify or param.init or name not in optional}
