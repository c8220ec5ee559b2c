"""Drives that a run allows: what is drawn of each, and what a simulator's joints take of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import yaml
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, ExportError, closest
from frictionzoo.core.params import UNITS
from frictionzoo.export.motor import Motor, motors
from frictionzoo.export.nearest import Nearest
from frictionzoo.result.evaluate import Values
from frictionzoo.result.identified import Identified
from frictionzoo.result.names import label_values, name_some
from frictionzoo.result.types import ValueRow

_SAME = 1e-9  # share of a quantity by which it may differ from a parameter that it is
_EXAMPLE = "'ranges={bench.armature: [0.8, 1.2]}'"
QUANTILES = 0.025, 0.975
MOTOR: Mapping[str, str] = {
    "stiffness": "stiffness",
    "damping": "damping",
    "saturation_effort": "torque",
    "velocity_limit": "velocity",
    "effort_limit": "torque",
}
"""What a `Motor` has, and of which dimension."""


class Range(NamedTuple):
    """What a user says that a parameter may be.

    Attributes:
        low: Lower end, as a share of its value.
        high: Upper end.
        absolute: Whether they are in its unit instead.
    """

    low: float
    high: float
    absolute: bool = False


Ranges = Mapping[str, Range]
"""By a parameter's full name, or that and a joint's."""


class Quantity(NamedTuple):
    """One number of each joint in all drives.

    Attributes:
        name: A parameter's full name, or what MuJoCo's joint or actuator has: `joint.armature`.
        unit: Its unit.
        values: In each drive; NaN where a joint has none.
        nominal: In the fitted drive.
        ends: Lower and upper end of its range.
        why: What the range is, in words, one a joint; empty where it is known.
    """

    name: str
    unit: str
    values: Float[np.ndarray, "count nv"]
    nominal: Float[np.ndarray, "nv"]
    ends: Float[np.ndarray, "nv 2"]
    why: tuple[str, ...]


@dataclass(frozen=True)
class Variants:
    """Drives that were drawn.

    Attributes:
        fitted: The drive that they are around.
        parameters: What varies in any joint.
        count: How many drives.
    """

    fitted: Identified
    parameters: tuple[Quantity, ...]
    count: int

    def at(self, number: int) -> Values:
        """Values of all parameters of one drive, as `Identified.values` has them."""
        return self.fitted.with_values({each.name: each.values[number] for each in self.parameters})

    @property
    def all(self) -> list[Values]:
        """Of each drive."""
        return [self.at(number) for number in range(self.count)]


def read_ranges(text: str, fitted: Identified) -> Ranges:
    """The option `ranges`: by name, two shares of the value, or `low` and `high` in the parameter's unit.

    Raises:
        ConfigError: It is no mapping of names to two numbers, or there is no such parameter.
    """
    try:
        given = yaml.safe_load(text)
    except yaml.YAMLError:
        given = None
    if not isinstance(given, dict):
        raise ConfigError(f"ranges={text}: expected shares of values by name, as in {_EXAMPLE}")
    rows = fitted.result["parameters"]
    known = {f"{row['owner']}.{row['name']}" for row in rows}.union(*map(label_values, rows))
    for name in given:
        if name not in known:
            raise ConfigError(f"ranges: {name}: no such parameter of this run; {closest(str(name), known)}")
    return {name: _read_range(name, of) for name, of in given.items()}


def _read_range(name: str, given: Any) -> Range:
    absolute = isinstance(given, dict) and given.keys() == {"low", "high"}
    ends = (given["low"], given["high"]) if absolute else given if isinstance(given, list) else ()
    try:
        low, high = map(float, ends)
    except (TypeError, ValueError):
        low = high = np.nan
    if not (-np.inf if absolute else 0) <= low < high < np.inf or not np.isfinite(low):
        raise ConfigError(
            f"ranges: {name}: {given}; expected the lowest and the highest share of its value, as in {_EXAMPLE}, or "
            "{low: NUMBER, high: NUMBER} in its unit"
        )
    return Range(low, high, absolute)


def draw_variants(fitted: Identified, count: int, seed: int, ranges: Ranges) -> Variants:
    """Draw drives: what data determine from its joint distribution, what has a range that was stated evenly from that.

    A determined parameter with a stated range keeps the order of its draws, so that it still goes with the others.

    Raises:
        ExportError: A parameter that was identified is not identifiable and has no stated range; or nothing varies.
        ConfigError: A stated range makes no sense of a parameter.
    """
    _refuse_vague(fitted, ranges)
    sure = any(entry["identifiable"] for row in fitted.result["parameters"] for entry in row["by_joint"])
    drawn = fitted.sample(count, seed) if sure else {}
    rng, found = np.random.default_rng((seed, 1)), list[Quantity]()
    for row, (name, parameter) in zip(fitted.result["parameters"], fitted.parameters.items(), strict=True):
        values = np.array(drawn.get(name, np.broadcast_to(parameter.value, (count, fitted.bench.nv))))
        ends, why = np.repeat(parameter.value[:, None], 2, axis=1), [""] * fitted.bench.nv
        for label, entry in label_values(row).items():
            joints, stated = [fitted.bench.joints.index(joint) for joint in entry["joints"]], _stated(ranges, label)
            if stated is not None:
                low, high = ends[joints] = _scale(fitted, label, entry, stated)
                values[:, joints] = _spread(values[:, joints], low, high, rng)
            elif entry["identified"]:
                ends[joints] = entry["interval"]
            for joint in joints if stated is not None or entry["identified"] else ():
                why[joint] = f"{'95 % interval' if stated is None else 'stated range'} of {name}"
        if any(why):
            found.append(Quantity(name, parameter.unit, values, parameter.value, ends, tuple(why)))
    if not found:
        raise ExportError(f"{fitted.place}: nothing was identified, expected what varies; state a range, {_EXAMPLE}")
    return Variants(fitted, tuple(found), count)


def _stated(ranges: Ranges, label: str) -> Range | None:
    """The range stated for an entry, by its own label or by its parameter's name."""
    return ranges.get(label, ranges.get(label.partition("/")[0]))


def _refuse_vague(fitted: Identified, ranges: Ranges) -> None:
    """ExportError where something was identified that data do not determine, and nobody states its range."""
    entries = {label: entry for row in fitted.result["parameters"] for label, entry in label_values(row).items()}
    vague = [
        label
        for label, entry in entries.items()
        if entry["identified"] and not entry["identifiable"] and _stated(ranges, label) is None
    ]
    if not vague:
        return
    missing = fitted.result["no_intervals"]
    why = f"no interval ({missing})" if missing else "not identifiable on the run's recordings"
    mend = "fit model=mujoco_default" if missing else "record what determines it (python -m frictionzoo.excite)"
    raise ExportError(
        f"{name_some(vague)}: {why}, expected a range to draw from; state it in shares of the value, "
        f"'ranges={{{vague[0]}: [0.8, 1.2]}}', or {mend} and export that run"
    )


def _scale(fitted: Identified, label: str, entry: ValueRow, stated: Range) -> Float[np.ndarray, "2"]:
    """The ends of a stated range in the parameter's unit; ConfigError where they make no sense of a value."""
    low, high = entry["low"], entry["high"]
    if label.partition("/")[0] == "bench.delay":  # commands of before are known as far back as this
        high = min(high, fitted.sampling.history * fitted.sampling.interval)
    first, last = sorted(end * (1 if stated.absolute else entry["value"]) for end in stated[:2])
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
    """Values evenly over a range, in the order of what was drawn, or in any order of what was not."""
    count, first = len(drawn), drawn[:, 0]
    order = np.argsort(np.argsort(first)) if np.ptp(first) > 0 else rng.permutation(count)
    return np.broadcast_to(low + (order[:, None] + 0.5) / count * (high - low), drawn.shape)


def list_quantities(
    variants: Variants, nominal: Nearest, each: Sequence[Nearest], inputs: Mapping[str, float]
) -> tuple[Quantity, ...]:
    """What MuJoCo's joints have of the drives, and what a position-controlled motor has where that varies.

    Args:
        variants: The drives.
        nominal: What MuJoCo's joints can hold of the fitted drive.
        each: Of each one that was drawn.
        inputs: Gain and supply of a servo.
    """
    fitted = variants.fitted
    units, own = UNITS[fitted.bench.joint_type], fitted.bench.own_damping
    values = [fitted.values, *variants.all]
    joint = {
        "armature": ("inertia", [one.bench["armature"] for one in (nominal, *each)]),
        "frictionloss": ("torque", [one.frictionloss for one in (nominal, *each)]),
        "damping": ("damping", [one.damping + own for one in (nominal, *each)]),
    }
    rest = [at_rest(fitted, v, one.frictionloss) for v, one in zip(values, (nominal, *each), strict=True)]
    if any((static != one.frictionloss).any() for static, one in zip(rest, (nominal, *each), strict=True)):
        joint["static_friction"] = ("torque", rest)
    found = [_describe(variants, f"joint.{name}", units[of], np.array(rows)) for name, (of, rows) in joint.items()]
    drives = [_motors(replace(fitted, values=of), inputs) for of in values]
    of_motor = []
    for name, of in MOTOR.items() if drives[0] else ():
        rows = np.array([[getattr(motor, name) for motor in joints] for joints in drives])
        if np.isfinite(rows).all():
            of_motor.append(_describe(variants, f"actuator.{name}", units[of], rows))
    # Programs set both gains together.
    gains = any(any(one.why) for one in of_motor[:2])
    return (*found, *(one for place, one in enumerate(of_motor) if any(one.why) or (gains and place < 2)))


def at_rest(fitted: Identified, values: Values, frictionloss: Float[np.ndarray, "nv"]) -> Float[np.ndarray, "nv"]:
    """Friction that holds a joint at rest [N m or N]: the law's `static_torque` where it has one."""
    found = frictionloss.copy()
    for joint in range(fitted.bench.nv):
        _, place, prefix = fitted.model.of_joint(joint)
        if (name := f"{prefix}static_torque") in values["friction"]:
            found[joint] = max(found[joint], values["friction"][name][place])
    return found


def _motors(fitted: Identified, inputs: Mapping[str, float]) -> list[Motor]:
    """The joints' position-controlled motors; none where they are no such."""
    try:
        return motors(fitted, inputs)
    except ExportError:
        return []


def _describe(variants: Variants, name: str, unit: str, rows: Float[np.ndarray, "drives nv"]) -> Quantity:
    """A quantity of the fitted drive, the first row, and of those that were drawn.

    Where it is a parameter, but for what does not vary, its range is that; else the middle 95 % of the draws.
    """
    nominal, values = rows[0], rows[1:]
    ends, why = np.repeat(nominal[:, None], 2, axis=1), [""] * len(nominal)
    for joint, size in enumerate(np.abs(nominal)):
        if np.ptp(values[:, joint]) <= _SAME * size:
            continue
        ends[joint], why[joint] = np.quantile(values[:, joint], QUANTILES), "middle 95 % of the draws"
        for parameter in variants.parameters:
            apart = values[:, joint] - parameter.values[:, joint]
            if parameter.why[joint] and np.ptp(apart) <= _SAME * size:
                ends[joint], why[joint] = parameter.ends[joint] + apart[0], parameter.why[joint]
    return Quantity(name, unit, values, nominal, ends, tuple(why))
