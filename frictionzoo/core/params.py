"""Parameters: value, unit, bounds, and the coordinate in which an optimiser moves them."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictionzoo.core.errors import ConfigError, MissingValueError, closest

AT_BOUND = 1e-4
"""Share of the bounds' distance, in the optimiser's coordinate, that counts as reaching a bound."""

AUTO = "auto"
"""Value of an option that is left open; `recipe=auto` chooses it on the training recordings."""

LARGEST = 1e12
"""Bound of a known value that a robot's file is to say, in any unit."""

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


_NOT_NEGATIVE = frozenset({"armature", "frictionloss", "damping", "delay", "kp", "kd", "torque_gain", "duty_gain"})
_NOT_NEGATIVE |= {"torque_limit", "torque_saturation", "stall_torque", "no_load_velocity", "duty_limit"}
_NOT_NEGATIVE |= {"kt_over_r", "kt2_over_r", "coulomb_torque", "static_torque", "kinetic_torque", "stiffness"}
_NOT_NEGATIVE |= {"micro_damping", "viscous_coefficient", "stribeck_velocity", "smoothing_velocity"}
"""Names of quantities that cannot be negative, whoever has them."""

PerJoint = float | tuple[float, ...] | Mapping[str, float]
"""A number for all joints, one for each in their order, or one for each pattern of joints' names."""
Tie = bool | Mapping[str, str] | None
"""Which joints share a value: none, all (true), those of each pattern by the group's name, or as the bench says."""


@dataclass(frozen=True)
class Param:
    """One physical quantity of each joint that is either known or identified.

    What differs from joint to joint is a tuple with an entry for each, or a mapping from patterns of joints' names,
    regular expressions that match whole names, of which the first that fits counts; `for_joints` makes that a tuple.

    Attributes:
        name: MuJoCo's or the literature's word.
        dimension: A key of `UNITS`; the unit follows from the joint's type.
        init: Initial value, and the value for good where `identify` is false; None where a robot's file is to say it.
        low: Lower bound.
        high: Upper bound.
        scale: `log`: the optimiser moves the logarithm, so that a step is a share of the value (needs low > 0); or a
            positive number: it moves value / scale, so that a step is a share of that number.
        identify: Whether a fit may change it; in a configuration also `auto`, which is no until a recipe says yes.
        tie: Joints that share one value; None: those that the bench ties.
        joints: Indices of the joints that have such a quantity, in order; what differs from joint to joint has entries
            for these alone. None: all.
        is_stated: Whether somebody stated `init`; a robot's file goes before a default that nobody stated.

    Raises:
        ConfigError: The bounds are empty, an identified value begins outside them, a known one is not finite, or the
            scale does not fit them.
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
        if len(sizes := sorted({len(each) for each in (low, high, init, free) if each.ndim})) > 1:
            raise ConfigError(
                f"{self.name}: lists of {' and '.join(map(str, sizes))} values; expected one value a joint in each"
            )
        if not np.isfinite(init).all() and not free.any():
            raise ConfigError(f"{self.name}: {_say(init)}; expected finite numbers")
        if not (low < high).all():
            raise ConfigError(f"{self.name}: bounds low={_say(low)}, high={_say(high)}; expected low < high")
        if not (~free | ((low <= init) & (init <= high))).all():  # bounds are of a fit, which leaves known values alone
            bounds = f"low={_say(low)}, high={_say(high)}"
            raise ConfigError(f"{self.name}: init={_say(init)} lies outside {bounds}; start inside")
        if self.scale == "log" and not (low > 0).all():
            raise ConfigError(f"{self.name}: low={_say(low)} with scale=log; expected low > 0, or a number as scale")

    @classmethod
    def from_config(cls, name: str, dimension: str, config: Mapping[str, Any]) -> "Param":
        """A parameter from its section of the configuration: `init`, `low`, `high`, `scale`, `identify`, all given.

        Where `init` is None and there is a `default`, that is the initial value, and nobody has stated one.

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
        """Whether nothing in it depends on joints' names."""
        return not any(part is None or isinstance(part, Mapping) for part in self._parts().values())

    @property
    def is_identified(self) -> bool:
        """Whether a fit may change it in any joint."""
        given = self.identify
        return any(given.values() if isinstance(given, Mapping) else np.atleast_1d(given))

    def for_joints(self, joints: Sequence[str | None]) -> "Param":
        """The same of a drive of these joints, a tuple in place of patterns; of joints without names numbers alone.

        Args:
            joints: Name of each joint, or None.

        Raises:
            ConfigError: A list has another length, a joint fits no pattern, or `init` is outside the bounds then.
        """
        own = [joints[joint] for joint in self.members(len(joints))]
        parts = {what: _resolve(f"{self.name}.{what}", part, own) for what, part in self._parts().items()}
        return replace(self, **parts)

    def members(self, nv: int) -> list[int]:
        """Indices of the joints that have such a quantity, of a drive of so many."""
        return list(range(nv) if self.joints is None else self.joints)

    def spread(self, own: Any, nv: int) -> np.ndarray:
        """An entry for each joint that has the quantity, or one for all of them, as an array of shape (nv,).

        NaN, of truth values false, where a joint has none.
        """
        own = np.asarray(own)
        if self.joints is None:
            return np.broadcast_to(own, nv)
        whole = np.full(nv, False if own.dtype == bool else np.nan, bool if own.dtype == bool else np.float64)
        whole[list(self.joints)] = own
        return whole

    def _parts(self) -> dict[str, Any]:
        """What may differ from joint to joint."""
        return {what: getattr(self, what) for what in ("init", "low", "high", "identify")}

    def each(self, what: str, nv: int) -> np.ndarray:
        """One of `init`, `low`, `high` and `identify` of each joint, of shape (nv,), as `spread` has it."""
        return self.spread(getattr(self, what), nv)

    def only(self, joints: Sequence[int]) -> "Param":
        """The same of the joints of these indices alone."""
        parts = {n: tuple(g[i] for i in joints) if isinstance(g, tuple) else g for n, g in self._parts().items()}
        return replace(self, **parts, tie=None)

    def to_coordinate(self, value: Any, xp: Any) -> Any:
        """The optimiser's coordinate of a physical value; `xp` is the array namespace."""
        return xp.log(value) if self.scale == "log" else value / self.scale

    def from_coordinate(self, coordinate: Any, xp: Any) -> Any:
        """The physical value of an optimiser's coordinate; `xp` is the array namespace."""
        return xp.exp(coordinate) if self.scale == "log" else coordinate * self.scale

    def is_at_bound(self, value: Any) -> Any:
        """Whether a physical value, or each one of an array, has reached a bound; of shape (nv,) of several joints."""
        value = np.asarray(value, np.float64)
        ends = [self.each(side, len(value)) if value.ndim else getattr(self, side) for side in ("low", "high")]
        with np.errstate(divide="ignore", invalid="ignore"):  # a known value may have no logarithm
            at, low, high = (self.to_coordinate(np.asarray(x, np.float64), np) for x in (value, *ends))
        return np.minimum(at - low, high - at) <= AT_BOUND * (high - low)

    def unit(self, joint_type: str) -> str:
        """Its unit on a `hinge` or a `slide`."""
        return UNITS[joint_type][self.dimension]


def fits(pattern: str, joint: str, option: str) -> bool:
    """Whether a regular expression matches a joint's whole name; ConfigError for none, by the option's name."""
    try:
        return re.fullmatch(pattern, joint) is not None
    except re.error as error:
        raise ConfigError(f"{option}: {pattern}: no pattern ({error}); expected a regular expression") from None


def group_joints(option: str, tie: Tie, joints: Sequence[str]) -> list[str]:
    """Name of the group of each joint that shares a value; a joint that shares with none is a group of its own name.

    Raises:
        ConfigError: A joint belongs to two groups, or a pattern fits none.
    """
    if not isinstance(tie, Mapping):
        return ["all joints"] * len(joints) if tie else list(joints)
    members = {group: [joint for joint in joints if fits(pattern, joint, option)] for group, pattern in tie.items()}
    for group, found in members.items():
        if not found:
            raise ConfigError(f"{option}.{group}={tie[group]}: no joint of that name; {closest(tie[group], joints)}")
    named = []
    for joint in joints:
        groups = [group for group, found in members.items() if joint in found]
        if len(groups) > 1:
            raise ConfigError(f"{option}: {joint} belongs to {' and '.join(groups)}, expected one group; change it")
        named.append(groups[0] if groups else joint)
    return named


def _say(value: np.ndarray) -> str:
    return ", ".join(f"{number:g}" for number in np.atleast_1d(value))


def _truth(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError(value)
    return value


def _per_joint(given: Any, read: Callable[[Any], Any]) -> Any:
    """A number for all joints, a tuple with one for each, or one for each pattern; None is none."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        return {str(pattern): read(value) for pattern, value in given.items()}
    if isinstance(given, Sequence) and not isinstance(given, str):
        return tuple(read(value) for value in given)
    return read(given)


def read_tie(option: str, given: Any) -> Tie:
    """Which joints share a value, as an option says; ConfigError where it says something else."""
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
    found = []
    for joint in joints:
        if joint is None:
            raise ConfigError(
                f"{option}: patterns of joints' names, but the joints have none; give a list, one a joint"
            )
        fitting = [value for pattern, value in given.items() if fits(pattern, joint, option)]
        if not fitting:
            raise ConfigError(f"{option}: no pattern of {', '.join(given)} fits {joint}; add one, such as '.*', last")
        found.append(fitting[0])
    return tuple(found)


def _complete(section: Any, defaults: Mapping[str, Any]) -> Any:
    """A parameter's whole section; of a known value, or one a joint, bounds mean nothing and lie around it."""
    alone = isinstance(section, Mapping) and set(section) == {"init"} and not defaults
    init = section["init"] if alone else section
    by_pattern = alone and isinstance(init, Mapping)
    known: list[Any] = list(init.values() if by_pattern else init if isinstance(init, list | tuple) else [init])
    if known == [None] and alone:
        return {"init": None, "low": -LARGEST, "high": LARGEST, "scale": 1.0, "identify": False}
    if known and all(isinstance(value, int | float) and not isinstance(value, bool) for value in known):
        reach = max(abs(value) for value in known) or 1.0
        bounds = {"low": min(known) - reach, "high": max(known) + reach}
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
    """The parameters that `owner` declares, from the configuration's section of the same names.

    Args:
        owner: Whose they are, for messages.
        dimensions: Dimension of each declared parameter.
        config: Section of each parameter, or its value if that is known.
        optional: Those among them that need no section, and that are left out where they are known to be 0: what they
            stand for is not there.
        defaults: What a section need not say, of each parameter that has such.
        ends: Those among `optional` that are there where they are 0.

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
    absent = {*optional} - {*ends}
    return {n: p for n, p in params.items() if n not in absent or p.is_identified or not _is_zero(p.init)}


def refuse_negative(prefix: str, params: Mapping[str, Param]) -> None:
    """ConfigError for a quantity below 0 that cannot be, or that a fit may make so; `prefix` stands before its name."""
    for name, param in params.items():
        if name.rpartition(".")[2] not in _NOT_NEGATIVE:
            continue
        for what in ("init", *(("low",) if param.is_identified else ())):
            value: Any = getattr(param, what)
            if value is None:
                continue
            numbers = np.array([*value.values()] if isinstance(value, Mapping) else value, np.float64)
            if (numbers < 0).any():
                said = name if what == "init" else f"{name}.low"
                raise ConfigError(f"{prefix}{said}={_say(numbers)}; expected 0 or more; correct the sign")


def _is_zero(given: Any) -> bool:
    return given is not None and not any(given.values() if isinstance(given, Mapping) else np.atleast_1d(given))
