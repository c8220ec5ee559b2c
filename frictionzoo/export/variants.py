"""Drives drawn from a run's parameter distribution, and their values in a simulator's joints."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import yaml
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, ExportError, closest
from frictionzoo.export.motor import MOTOR, motors
from frictionzoo.export.nearest import Nearest
from frictionzoo.result.evaluate import Values
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.names import label_values, name_some
from frictionzoo.result.types import Value

_SAME = 1e-9  # relative tolerance for a quantity to equal a parameter
_EXAMPLE = "'ranges={bench.armature: [0.8, 1.2]}'"
QUANTILES = 0.025, 0.975


class Range(NamedTuple):
    """Range of a parameter stated by the user: shares of its value, or, if `absolute`, values in its unit."""

    low: float
    high: float
    absolute: bool = False


Ranges = Mapping[str, Range]
"""Ranges by the full name of a parameter, optionally with a joint."""


class Quantity(NamedTuple):
    """A quantity of each joint in all drives.

    Attributes:
        name: Full name of a parameter, or of a property of MuJoCo's joint or actuator: `joint.armature`.
        values: Values in each drive; NaN for joints without it.
        nominal: Values in the fitted drive.
        ends: Lower and upper end of its range.
        why: Origin of the range in words, for each joint; empty if the value is known.
    """

    name: str
    unit: str
    values: Float[np.ndarray, "count nv"]
    nominal: Float[np.ndarray, "nv"]
    ends: Float[np.ndarray, "nv 2"]
    why: tuple[str, ...]


def read_ranges(text: str, fitted: FittedDrive) -> Ranges:
    """Read the option `ranges`: for each name two shares of the value, or `low` and `high` in the parameter's unit.

    Raises:
        ConfigError: The option is not a mapping from names to two numbers, or there is no such parameter.
    """
    try:
        stated = yaml.safe_load(text)
    except yaml.YAMLError:
        stated = None
    if not isinstance(stated, dict):
        raise ConfigError(f"ranges={text}: expected shares of values by name, as in {_EXAMPLE}")
    rows = fitted.result.parameters
    names = {f"{row.owner}.{row.name}" for row in rows}.union(*map(label_values, rows))
    ranges = {}
    for name, given in stated.items():
        if name not in names:
            raise ConfigError(f"ranges: {name}: no such parameter of this run; {closest(str(name), names)}")
        absolute = isinstance(given, dict) and given.keys() == {"low", "high"}
        ends = (given["low"], given["high"]) if absolute else given if isinstance(given, list) else ()
        try:
            low, high = map(float, ends)
        except (TypeError, ValueError):
            low = high = np.nan
        if not (-np.inf if absolute else 0) <= low < high < np.inf or not np.isfinite(low):
            raise ConfigError(
                f"ranges: {name}: {given}; expected the lowest and the highest share of its value, as in {_EXAMPLE}, "
                "or {low: NUMBER, high: NUMBER} in its unit"
            )
        ranges[name] = Range(low, high, absolute)
    return ranges


def draw_variants(fitted: FittedDrive, count: int, seed: int, ranges: Ranges) -> tuple[Quantity, ...]:
    """Draw the parameters that vary: identifiable ones from their joint distribution, those with a range uniformly.

    An identifiable parameter with a stated range keeps the order of its draws, and so its correlations.

    Raises:
        ExportError: An identified parameter is not identifiable and has no stated range; or no parameter varies.
        ConfigError: A stated range is invalid for its parameter.
    """
    _refuse_vague(fitted, ranges)
    any_identifiable = any(entry.identifiable for row in fitted.result.parameters for entry in row.by_joint)
    drawn = fitted.sample(count, seed) if any_identifiable else {}
    rng, quantities = np.random.default_rng((seed, 1)), list[Quantity]()
    for row, (name, parameter) in zip(fitted.result.parameters, fitted.parameters.items(), strict=True):
        values = np.array(drawn.get(name, np.broadcast_to(parameter.value, (count, fitted.bench.nv))))
        ends, why = np.repeat(parameter.value[:, None], 2, axis=1), [""] * fitted.bench.nv
        for label, entry in label_values(row).items():
            joints, stated = [fitted.bench.joints.index(joint) for joint in entry.joints], _stated(ranges, label)
            if stated is not None:
                low, high = ends[joints] = _scale(fitted, label, entry, stated)
                values[:, joints] = _spread(values[:, joints], low, high, rng)
            elif entry.identified:
                ends[joints] = entry.interval
            for joint in joints if stated is not None or entry.identified else ():
                why[joint] = f"{'95 % interval' if stated is None else 'stated range'} of {name}"
        if any(why):
            quantities.append(Quantity(name, parameter.unit, values, parameter.value, ends, tuple(why)))
    if not quantities:
        raise ExportError(f"{fitted.place}: nothing was identified, expected what varies; state a range, {_EXAMPLE}")
    return tuple(quantities)


def _stated(ranges: Ranges, label: str) -> Range | None:
    """Return the range stated for an entry, by its label or its parameter's name; None if there is none."""
    return ranges.get(label, ranges.get(label.partition("/")[0]))


def _refuse_vague(fitted: FittedDrive, ranges: Ranges) -> None:
    vague = [
        label
        for row in fitted.result.parameters
        for label, entry in label_values(row).items()
        if entry.identified and not entry.identifiable and _stated(ranges, label) is None
    ]
    if not vague:
        return
    missing = fitted.result.no_intervals
    why = f"no interval ({missing})" if missing else "not identifiable on the run's recordings"
    advice = "fit model=mujoco_default" if missing else "record what determines it (python -m frictionzoo.design)"
    raise ExportError(
        f"{name_some(vague)}: {why}, expected a range to draw from; state it in shares of the value, "
        f"'ranges={{{vague[0]}: [0.8, 1.2]}}', or {advice} and export that run"
    )


def _scale(fitted: FittedDrive, label: str, entry: Value, stated: Range) -> Float[np.ndarray, "2"]:
    """Return the ends of a stated range in the parameter's unit; raise ConfigError if they are invalid."""
    low, high = entry.low, entry.high
    if label.partition("/")[0] == "bench.delay":  # longest delay covered by the recorded history
        high = min(high, fitted.sampling.history * fitted.sampling.interval)
    first, last = sorted(end * (1 if stated.absolute else entry.value) for end in stated[:2])
    if first == last:
        line = "its value is 0, expected one to take shares of; give {low: NUMBER, high: NUMBER} in its unit"
        raise ConfigError(f"ranges: {label}: {line}")
    if first < low or last > high:
        raise ConfigError(
            f"ranges: {label}: {first:g} to {last:g}, expected them within {low:g} to {high:g}; narrow it"
        )
    return np.array([first, last])


def _spread(
    drawn: Float[np.ndarray, "count joints"], low: float, high: float, rng: np.random.Generator
) -> Float[np.ndarray, "count joints"]:
    """Spread values evenly over a range, in the order of the draws, or in random order without draws."""
    count, column = len(drawn), drawn[:, 0]
    order = np.argsort(np.argsort(column)) if np.ptp(column) > 0 else rng.permutation(count)
    return np.broadcast_to(low + (order[:, None] + 0.5) / count * (high - low), drawn.shape)


def list_quantities(
    fitted: FittedDrive,
    parameters: Sequence[Quantity],
    values: Sequence[Values],
    drives: Sequence[Nearest],
    inputs: Mapping[str, float],
) -> tuple[Quantity, ...]:
    """List quantities of MuJoCo's joints, and varying quantities of a position-controlled motor.

    `values` are those of the fitted drive and of each drawn one, `drives` the same with MuJoCo's joint friction;
    `inputs` are gain and supply of a servo.
    """
    units = fitted.units
    joint = {
        "armature": ("inertia", [drive.bench["armature"] for drive in drives]),
        "frictionloss": ("torque", [drive.frictionloss for drive in drives]),
        "damping": ("damping", [drive.damping + fitted.bench.own_damping for drive in drives]),
    }
    static = [at_rest(fitted, of, drive.frictionloss) for of, drive in zip(values, drives, strict=True)]
    if any((torque != drive.frictionloss).any() for torque, drive in zip(static, drives, strict=True)):
        joint["static_friction"] = ("torque", static)
    quantities = [
        _describe(parameters, f"joint.{name}", units[of], np.array(rows)) for name, (of, rows) in joint.items()
    ]
    try:
        motors_of = [motors(replace(fitted, values=of), inputs) for of in values]
    except ExportError:  # not position-controlled
        return tuple(quantities)
    of_motor = []
    for name, of in MOTOR.items():
        rows = np.array([[getattr(motor, name) for motor in joints] for joints in motors_of])
        if np.isfinite(rows).all():
            of_motor.append(_describe(parameters, f"actuator.{name}", units[of], rows))
    gains = any(any(one.why) for one in of_motor[:2])  # simulators set both gains together
    return (*quantities, *(one for place, one in enumerate(of_motor) if any(one.why) or (gains and place < 2)))


def at_rest(fitted: FittedDrive, values: Values, frictionloss: Float[np.ndarray, "nv"]) -> Float[np.ndarray, "nv"]:
    """Return the friction that holds a joint at rest [N m or N]: `static_torque` if the model has it."""
    friction = frictionloss.copy()
    for joint in range(fitted.bench.nv):
        _, place, prefix = fitted.model.of_joint(joint)
        if (name := f"{prefix}static_torque") in values["friction"]:
            friction[joint] = max(friction[joint], values["friction"][name][place])
    return friction


def _describe(parameters: Sequence[Quantity], name: str, unit: str, rows: Float[np.ndarray, "drives nv"]) -> Quantity:
    """Describe a quantity; the first row is the fitted drive, the others are drawn drives."""
    nominal, values = rows[0], rows[1:]
    ends, why = np.repeat(nominal[:, None], 2, axis=1), [""] * len(nominal)
    for joint, size in enumerate(np.abs(nominal)):
        if np.ptp(values[:, joint]) <= _SAME * size:
            continue
        ends[joint], why[joint] = np.quantile(values[:, joint], QUANTILES), "middle 95 % of the draws"
        for parameter in parameters:
            # A quantity that equals a parameter plus a constant has the parameter's range.
            difference = values[:, joint] - parameter.values[:, joint]
            if parameter.why[joint] and np.ptp(difference) <= _SAME * size:
                ends[joint], why[joint] = parameter.ends[joint] + difference[0], parameter.why[joint]
    return Quantity(name, unit, values, nominal, ends, tuple(why))
