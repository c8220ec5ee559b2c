"""Units of recorded signals and their conversion to SI."""

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Real

from frictionzoo.core.errors import ConfigError, closest

Ratio = tuple[float, float]
"""SI units per unit, as numerator and denominator: dividing by 1000 is exact to the last bit, a factor 0.001 is not."""

POSITION: Mapping[str, Ratio] = {
    **{"rad": (1.0, 1.0), "mrad": (1.0, 1e3), "deg": (math.pi, 180.0), "rev": (math.tau, 1.0)},
    **{"m": (1.0, 1.0), "mm": (1.0, 1e3), "um": (1.0, 1e6)},
}
VELOCITY: Mapping[str, Ratio] = {
    **{"rad/s": (1.0, 1.0), "deg/s": (math.pi, 180.0), "rev/s": (math.tau, 1.0), "rpm": (math.tau, 60.0)},
    **{"m/s": (1.0, 1.0), "mm/s": (1.0, 1e3)},
}
TORQUE: Mapping[str, Ratio] = {"N m": (1.0, 1.0), "mN m": (1.0, 1e3), "N": (1.0, 1.0)}
EFFORT: Mapping[str, Ratio] = {
    **TORQUE,
    **{"A": (1.0, 1.0), "mA": (1.0, 1e3)},
    **{"V": (1.0, 1.0), "mV": (1.0, 1e3), "%": (1.0, 100.0), "1": (1.0, 1.0)},
}
UNITS: Mapping[str, Mapping[str, Ratio]] = {
    "time": {"s": (1.0, 1.0), "ms": (1.0, 1e3), "us": (1.0, 1e6), "ns": (1.0, 1e9)},
    "qpos": POSITION,
    "qvel": VELOCITY,
    "ctrl": {**POSITION, **VELOCITY, **EFFORT},
    "ctrl_velocity": VELOCITY,
    "ctrl_torque": TORQUE,
    "kp": {"N m/rad": (1.0, 1.0), "N m/deg": (180.0, math.pi), "N/m": (1.0, 1.0), "N/mm": (1e3, 1.0)},
    "kd": {"N m s/rad": (1.0, 1.0), "N m s/deg": (180.0, math.pi), "N s/m": (1.0, 1.0), "N s/mm": (1e3, 1.0)},
    "torque": TORQUE,
    "supply": {"V": (1.0, 1.0), "mV": (1.0, 1e3)},
    "enable": {"1": (1.0, 1.0)},
    "temperature": {"degC": (1.0, 1.0)},
}
"""Units of each signal by name; the first is the default."""


def ratio(signal: str, unit: str) -> Ratio:
    """Return the number of SI units in one unit of a signal, as a fraction.

    `unit` is a name, with or without spaces; or a number, the SI units per step of a raw register.

    Raises:
        ConfigError: The signal has no such unit.
    """
    units = UNITS[signal]
    for name, fraction in units.items():
        if unit.replace(" ", "") == name.replace(" ", ""):
            return fraction
    try:
        factor = float(unit)
    except ValueError:
        factor = math.nan
    if not math.isfinite(factor) or factor == 0:
        raise ConfigError(f"data.units.{signal}={unit}: unknown unit; {closest(unit, units)}, or a number of SI units")
    return factor, 1.0


def to_si(values: Real[np.ndarray, "rows"], fraction: Ratio) -> Float[np.ndarray, "rows"]:
    """Convert values to SI units; values already in SI keep every bit."""
    numerator, denominator = fraction
    scaled = values.astype(np.float64)
    with np.errstate(over="ignore"):  # `to_recording` refuses absurd numbers
        if numerator != 1:
            scaled = scaled * numerator
        return scaled / denominator


SLOW_JOINT = 25.0  # per second; a joint that moves at most this many degrees per second hardly shows its friction
WHOLE_RANGE = 720.0  # degrees; a joint that turns further has no range, so that its many turns are no sign of degrees
ONE_WAY = 0.2  # share of the way in the rarer direction, below which a joint turns on and on


def could_be_degrees(position: Float[np.ndarray, "rows"], time: Float[np.ndarray, "rows"] | None = None) -> bool:
    """Return whether an angle in an unknown unit moves like a joint in degrees rather than a wheel in radians.

    A wheel turns on and on, or further than the range of any joint; a joint moves to and fro, by many degrees per
    second. `time` is in s; None: not considered.
    """
    finite = np.isfinite(position)
    steps = np.diff(position[finite])
    way = float(np.abs(steps).sum())
    back = min(float(steps[steps > 0].sum()), -float(steps[steps < 0].sum()))
    span = float(np.ptp(position[finite])) if finite.any() else 0.0
    if span > WHOLE_RANGE or not back > ONE_WAY * way / 2:
        return False
    if time is None:
        return True
    intervals = np.diff(time[finite])
    speeds = np.abs(steps[intervals > 0]) / intervals[intervals > 0]
    return not len(speeds) or float(np.quantile(speeds, 0.99)) > SLOW_JOINT
