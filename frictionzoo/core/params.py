"""Parameters: value, unit, bounds, and the solver's coordinate."""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictionzoo.core.errors import ConfigError, MissingValueError, closest
from frictionzoo.core.units import TYPICAL, UNITS

AUTO = "auto"
"""Value of an automatic setting, which `recipe=auto` chooses on the training recordings."""

LARGEST = 1e12
"""Bound, in any unit, of a known value that has to come from the robot's file."""

_NOT_NEGATIVE = frozenset({"armature", "frictionloss", "damping", "delay", "kp", "kd", "torque_gain", "duty_gain"})
_NOT_NEGATIVE |= {"torque_limit", "torque_saturation", "stall_torque", "no_load_velocity", "duty_limit"}
_NOT_NEGATIVE |= {"kt_over_r", "kt2_over_r", "coulomb_torque", "static_torque", "kinetic_torque", "stiffness"}
_NOT_NEGATIVE |= {"micro_damping", "viscous_coefficient", "stribeck_velocity", "smoothing_velocity"}
"""Names of quantities that cannot be negative, in benches and models."""
_PARTS = ("init", "low", "high", "identify")  # attributes of a parameter that may differ between joints

PerJoint = float | tuple[float, ...] | Mapping[str, float]
"""One number for all joints, one for each joint in order, or one for each pattern of joint names."""
Tie = bool | Mapping[str, str] | None
"""Joints that share a value: all (true), none (false), those matching each group's pattern; None: as in the bench."""


@dataclass(frozen=True)
class Parameter:
    """Physical parameter as a friction model's class declares it, for every bench.

    `init`, `low` and `high` are multiples of the bench's typical torque, velocity, damping or inertia (`scale` of a
    configuration), so they suit both a servo and a carriage, or in SI units for dimensions that
    `frictionzoo.core.units.TYPICAL` does not contain.

    Attributes:
        dimension: One of `frictionzoo.core.units.DIMENSIONS`.
        init: Initial value.
        low: Lower bound.
        high: Upper bound.
        scale: As in `Param`.
        identify: Whether a fit may change it by default.
        from_robot: Whether a value of this name in the robot's file, of `<joint>` or of a `<dcmotor>`'s friction,
            replaces `init`.
    """

    dimension: str
    init: float | int
    low: float | int
    high: float | int
    scale: str | float | int = "log"
    identify: bool = True
    from_robot: bool = False

    def section(self) -> dict[str, Any]:
        """Return its section of a configuration, with references to the bench's `scale`."""
        typical = TYPICAL.get(self.dimension)
        init, low, high = (typical % each if typical else each for each in (self.init, self.low, self.high))
        start = {"init": None, "default": init} if self.from_robot else {"init": init}
        return {**start, "low": low, "high": high, "scale": self.scale, "identify": self.identify}


@dataclass(frozen=True)
class Param:
    """Physical quantity of each joint, known or identified.

    `init`, `low`, `high` and `identify` may differ between joints, as a tuple or as a mapping from patterns of joint
    names (regular expressions for whole names; the first match counts). `for_joints` turns a mapping into a tuple.

    Attributes:
        name: MuJoCo's or the literature's word.
        dimension: One of `frictionzoo.core.units.DIMENSIONS`; the unit follows from the joint's type.
        init: Initial value, constant where `identify` is false; None if the robot's file has to give it.
        low: Lower bound.
        high: Upper bound.
        scale: `log`: the solver moves the logarithm, so a step is relative to the value (needs low > 0). A positive
            number: the solver moves value / scale.
        identify: Whether a fit may change it; `auto` in a configuration is false until a recipe decides.
        tie: Joints that share one value; None: as in the bench.
        joints: Indices of the joints that have this quantity, in the order of the tuples; None: all.
        is_stated: Whether a user stated `init`. The robot's file overrides only a value that nobody stated.

    Raises:
        ConfigError: The bounds are empty or do not fit the scale, an identified value starts outside them, or a known
            value is not finite.
    """

    name: str
    dimension: str
    init: PerJoint | None
    low: PerJoint
    high: PerJoint
    scale: str | float
    identify: bool | tuple[bool, ...] | Mapping[str, bool]
    tie: Tie = None
    joints: tuple[int, ...] | None = None
    is_stated: bool = True

    def __post_init__(self) -> None:
        if self.scale != "log" and (isinstance(self.scale, str) or not self.scale > 0):
            raise ConfigError(f"{self.name}: scale={self.scale}; expected log or a positive number")
        if not self.is_resolved:
            return
        low, high, init = (np.asarray(side, np.float64) for side in (self.low, self.high, self.init))
        free = np.asarray(self.identify, bool)
        if len(sizes := sorted({len(values) for values in (low, high, init, free) if values.ndim})) > 1:
            raise ConfigError(
                f"{self.name}: lists of {' and '.join(map(str, sizes))} values; expected one value a joint in each"
            )
        if not np.isfinite(init).all() and not free.any():
            raise ConfigError(f"{self.name}: {_say(init)}; expected finite numbers")
        if not (low < high).all():
            raise ConfigError(f"{self.name}: bounds low={_say(low)}, high={_say(high)}; expected low < high")
        if not (~free | ((low <= init) & (init <= high))).all():  # bounds apply to identified values only
            bounds = f"low={_say(low)}, high={_say(high)}"
            raise ConfigError(f"{self.name}: init={_say(init)} lies outside {bounds}; start inside")
        if self.scale == "log" and not (low > 0).all():
            raise ConfigError(f"{self.name}: low={_say(low)} with scale=log; expected low > 0, or a number as scale")

    @classmethod
    def from_config(cls, name: str, dimension: str, config: Mapping[str, Any]) -> "Param":
        """Create a parameter from a configuration section with `init`, `low`, `high`, `scale` and `identify`.

        If `init` is None, an optional `default` is the initial value and counts as not stated.

        Raises:
            ConfigError: A key is missing, unknown or of the wrong type.
        """
        keys = {"init", "low", "high", "scale", "identify"}
        if not isinstance(config, Mapping):
            raise ConfigError(f"{name}={config!r}; expected a number, or a section with {', '.join(sorted(keys))}")
        optional = {"tie", "default"}
        for key in set(config) - keys - optional:
            raise ConfigError(f"{name}.{key}: unknown option; {closest(str(key), keys | optional)}")
        for key in keys - set(config):
            raise ConfigError(f"{name}.{key}: missing; give {', '.join(sorted(keys))}")
        try:
            scale = config["scale"] if config["scale"] == "log" else float(config["scale"])
            init, low, high, default = (
                _per_joint(config.get(key), float) for key in ("init", "low", "high", "default")
            )
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{name}: {error}; init, low, high are numbers, scale is log or a number") from None
        try:
            identify = config["identify"] != AUTO and _per_joint(config["identify"], _truth)
        except TypeError:
            raise ConfigError(f"{name}.identify={config['identify']}; expected true or false") from None
        tie, is_stated = read_tie(f"{name}.tie", config.get("tie")), init is not None or default is None
        return cls(name, dimension, init if is_stated else default, low, high, scale, identify, tie, None, is_stated)

    @property
    def is_resolved(self) -> bool:
        """Whether no part is missing or depends on joint names."""
        return not any(part is None or isinstance(part, Mapping) for part in self._parts().values())

    @property
    def is_identified(self) -> bool:
        """Whether a fit may change it in any joint."""
        identify = self.identify
        return any(identify.values() if isinstance(identify, Mapping) else np.atleast_1d(identify))

    def for_joints(self, joints: Sequence[str | None]) -> "Param":
        """Return the parameter for joints with these names (or None), with tuples in place of patterns.

        Raises:
            ConfigError: A list has the wrong length, a joint matches no pattern, or `init` is then outside the bounds.
            MissingValueError: A value is None.
        """
        names = [joints[joint] for joint in self.members(len(joints))]
        return replace(self, **{n: _resolve(f"{self.name}.{n}", part, names) for n, part in self._parts().items()})

    def members(self, nv: int) -> list[int]:
        """Return the indices of the joints that have this quantity, out of `nv`."""
        return list(range(nv) if self.joints is None else self.joints)

    def spread(self, own: Any, nv: int) -> np.ndarray:
        """Return an array of shape (nv,) from one value for all joints or one for each that has the quantity.

        Joints without the quantity get NaN, or false for truth values.
        """
        own = np.asarray(own)
        if self.joints is None:
            return np.broadcast_to(own, nv)
        values = np.full(nv, False if own.dtype == bool else np.nan, bool if own.dtype == bool else np.float64)
        values[list(self.joints)] = own
        return values

    def _parts(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in _PARTS}

    def each(self, what: str, nv: int) -> np.ndarray:
        """Return `init`, `low`, `high` or `identify` of each joint, shape (nv,), NaN or false as in `spread`."""
        return self.spread(getattr(self, what), nv)

    def only(self, joints: Sequence[int]) -> "Param":
        """Return the parameter of the joints with these indices only."""
        parts = {n: tuple(g[i] for i in joints) if isinstance(g, tuple) else g for n, g in self._parts().items()}
        return replace(self, **parts, tie=None)

    def to_coordinate(self, value: Any, xp: Any) -> Any:
        """Return the solver's coordinate of a physical value; `xp` is the array namespace."""
        return xp.log(value) if self.scale == "log" else value / self.scale

    def from_coordinate(self, coordinate: Any, xp: Any) -> Any:
        """Return the physical value of a solver's coordinate; `xp` is the array namespace."""
        return xp.exp(coordinate) if self.scale == "log" else coordinate * self.scale

    def is_at_bound(self, value: Any) -> Any:
        """Return whether a physical value, or each of shape (nv,), has reached a bound."""
        value = np.asarray(value, np.float64)
        ends = [self.each(side, len(value)) if value.ndim else getattr(self, side) for side in ("low", "high")]
        with np.errstate(divide="ignore", invalid="ignore"):  # a known value may have no logarithm
            coordinate, low, high = (self.to_coordinate(np.asarray(x, np.float64), np) for x in (value, *ends))
        return np.minimum(coordinate - low, high - coordinate) <= 1e-4 * (high - low)

    def unit(self, joint_type: str) -> str:
        """Return its unit on a `hinge` or a `slide`."""
        return UNITS[joint_type][self.dimension]

    def line(self, values: Iterable[float], joint_type: str) -> str:
        """Return values of its joints, and the bounds if a fit may change it, as a line of text."""
        bounds = f", identified within {_text(self.low)} to {_text(self.high)}" if self.is_identified else ""
        return f"{self.name}: {', '.join(f'{value:.4g}' for value in values)} {self.unit(joint_type)}{bounds}"


def fits(pattern: str, joint: str, option: str) -> bool:
    """Return whether a regular expression matches a joint's whole name; ConfigError for an invalid expression."""
    try:
        return re.fullmatch(pattern, joint) is not None
    except re.error as error:
        raise ConfigError(f"{option}: {pattern}: no pattern ({error}); expected a regular expression") from None


def group_joints(option: str, tie: Tie, joints: Sequence[str]) -> list[str]:
    """Return the name of each joint's group, which shares a value; for an untied joint, the joint's name.

    Raises:
        ConfigError: A joint belongs to two groups, or a pattern matches no joint.
    """
    if not isinstance(tie, Mapping):
        return ["all joints"] * len(joints) if tie else list(joints)
    members = {group: [joint for joint in joints if fits(pattern, joint, option)] for group, pattern in tie.items()}
    for group, matching in members.items():
        if not matching:
            raise ConfigError(f"{option}.{group}={tie[group]}: no joint of that name; {closest(tie[group], joints)}")
    group_names = []
    for joint in joints:
        groups = [group for group, matching in members.items() if joint in matching]
        if len(groups) > 1:
            raise ConfigError(f"{option}: {joint} belongs to {' and '.join(groups)}, expected one group; change it")
        group_names.append(groups[0] if groups else joint)
    return group_names


def _say(value: np.ndarray) -> str:
    return ", ".join(f"{number:g}" for number in np.atleast_1d(value))


def _text(value: PerJoint) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{number:g} of {joint}" for joint, number in value.items())
    return _say(np.asarray(value))


def _truth(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError(value)
    return value


def _per_joint(given: Any, read: Callable[[Any], Any]) -> Any:
    """Read a number for all joints, a sequence with one a joint, or a mapping from patterns; None stays None."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        return {str(pattern): read(value) for pattern, value in given.items()}
    if isinstance(given, Sequence) and not isinstance(given, str):
        return tuple(read(value) for value in given)
    return read(given)


def read_tie(option: str, given: Any) -> Tie:
    """Return the tied joints from the value of an option; ConfigError for any other value."""
    if given is None or isinstance(given, bool):
        return given
    if not isinstance(given, Mapping) or not all(isinstance(pattern, str) for pattern in given.values()):
        raise ConfigError(f"{option}={given}; expected true, false, or names of groups with patterns of joints")
    return {str(group): pattern for group, pattern in given.items()}


def _resolve(option: str, given: Any, joints: Sequence[str | None]) -> Any:
    if given is None:
        raise MissingValueError(f"{option}: null, expected a value; give it, as in {option}=1.5")
    if isinstance(given, tuple) and len(given) != len(joints):
        raise ConfigError(f"{option}: {len(given)} values, expected {len(joints)}, one a joint, or one for all")
    if not isinstance(given, Mapping):
        return given
    values = []
    for joint in joints:
        if joint is None:
            raise ConfigError(
                f"{option}: patterns of joints' names, but the joints have none; give a list, one a joint"
            )
        matches = [value for pattern, value in given.items() if fits(pattern, joint, option)]
        if not matches:
            raise ConfigError(f"{option}: no pattern of {', '.join(given)} fits {joint}; add one, such as '.*', last")
        values.append(matches[0])
    return tuple(values)


def _complete(section: Any, defaults: Mapping[str, Any]) -> Any:
    """Complete a parameter's section; a known value gets bounds around it, which no fit uses."""
    only_init = isinstance(section, Mapping) and set(section) == {"init"} and not defaults
    init = section["init"] if only_init else section
    by_pattern = only_init and isinstance(init, Mapping)
    values: list[Any] = list(init.values() if by_pattern else init if isinstance(init, list | tuple) else [init])
    if values == [None] and only_init:
        return {"init": None, "low": -LARGEST, "high": LARGEST, "scale": 1.0, "identify": False}
    if values and all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        reach = max(abs(value) for value in values) or 1.0
        bounds = {"low": min(values) - reach, "high": max(values) + reach}
        return {"init": init, **bounds, "scale": reach, "identify": False}
    return {**defaults, **section} if isinstance(section, Mapping) else section


def read_params(
    owner: str,
    dimensions: Mapping[str, str],
    config: Mapping[str, Any],
    optional: Collection[str] = (),
    defaults: Mapping[str, Mapping[str, Any]] | None = None,
    ends: Collection[str] = (),
) -> dict[str, Param]:
    """Return the parameters in `dimensions`, from sections of the same names, or from values if known.

    Parameters in `optional` need no section. One that is known to be 0 is dropped, because its effect is absent, unless
    it is in `ends`. `defaults` has default entries of sections; messages name the `owner`.

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
    droppable = {*optional} - {*ends}
    kept = {n for n, p in params.items() if p.is_identified or p.init is None or _list_numbers(p.init).any()}
    return {name: param for name, param in params.items() if name in kept or name not in droppable}


def refuse_negative(prefix: str, params: Mapping[str, Param]) -> None:
    """Refuse negative values and lower bounds of quantities that cannot be negative.

    Raises:
        ConfigError: The message names the quantity after `prefix`.
    """
    for name, param in params.items():
        if name.rpartition(".")[2] not in _NOT_NEGATIVE:
            continue
        for option, value in ((name, param.init), (f"{name}.low", param.low if param.is_identified else None)):
            numbers = _list_numbers(value)
            if (numbers < 0).any():
                raise ConfigError(f"{prefix}{option}={_say(numbers)}; expected 0 or more; correct the sign")


def _list_numbers(value: PerJoint | None) -> np.ndarray:
    numbers: Any = [] if value is None else [*value.values()] if isinstance(value, Mapping) else value
    return np.atleast_1d(np.array(numbers, np.float64))
