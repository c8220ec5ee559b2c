"""Options of `python -m frictionzoo.design`: the recording, and the options of a run that choose the drive."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar, cast

import yaml
from omegaconf import OmegaConf

from frictionzoo.core.config import (
    compose_config,
    create_literal,
    keep_caches_at_home,
    list_choices,
    override,
    resolve,
)
from frictionzoo.core.errors import ConfigError, closest, read_number, refuse_outside
from frictionzoo.design.design import SearchOptions
from frictionzoo.design.information import SensorNoise
from frictionzoo.design.series import Series
from frictionzoo.models.by_name import complete_laws
from frictionzoo.result.fitted_drive import FittedDrive

Part = TypeVar("Part", bound=Any)  # any dataclass of numbers and names
LIMITS = ("position", "velocity", "torque")
_GROUPS = ("bench", "model", "data", "experiment")
_OF_A_RUN = ("bench", "model", "scale", "segments.length", "loss.position", "loss.velocity", "engine", "device")
_INPUTS = "inputs."


@dataclass(frozen=True)
class Plan:
    """Options of the command and its recording.

    Attributes:
        seconds: Duration of the command [s].
        rate: Samples per second of the command and the recording; 0: one for each simulation step.
        ramp: Duration of the ramps at both ends [s].
        period: Longest period of the command [s].
        bandwidth: Highest frequency of the command [Hz].
        margin: Unused share of each limit, a reserve for differences between drive and simulation.
        points: Points per second of the ROS 2 trajectory.
        fps: LeRobot actions per second.

    Raises:
        ConfigError: An option is invalid.
    """

    seconds: float = 20.0
    rate: float = 0.0
    ramp: float = 1.0
    period: float = 20.0
    bandwidth: float = 8.0
    margin: float = 0.05
    points: float = 100.0
    fps: float = 50.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("seconds", 0.1, 10_000),
            ("rate", 0, 100_000),
            ("ramp", 0.01, 1000),
            ("period", 0.1, 1000),
            ("bandwidth", 0.01, 10_000),
            ("margin", 0, 0.9),
            ("points", 1, 10_000),
            ("fps", 1, 10_000),
        ):
            refuse_outside(name, getattr(self, name), low, high)
        if not self.seconds > 2 * self.ramp:
            raise ConfigError(f"seconds={self.seconds:g}: expected more than both ramps of {self.ramp:g} s")

    def series(self, interval: float, length: int) -> Series:
        """Return the command's series for an interval [s], with a whole number of segments of `length` in a period."""
        samples, ramp = round(self.seconds / interval) + 1, max(round(self.ramp / interval), 1)
        inner = samples - 1 - 2 * ramp
        periods = max(1, -(-inner // max(round(self.period / interval), 1)))
        period = max(1, inner // (periods * length)) * length
        return Series(samples, interval, period, ramp, self.bandwidth)


@dataclass(frozen=True)
class Request:
    """All options of an experiment design.

    Attributes:
        limits: `position`, `velocity`, `torque`, and `home` if given, as the user wrote them.
        inputs: Further inputs of the actuator model, by name.
        settings: Settings of a run, with the bench and the friction model.
    """

    plan: Plan
    noise: SensorNoise
    search: SearchOptions
    limits: Mapping[str, Any]
    inputs: Mapping[str, float]
    settings: Mapping[str, Any]

    @classmethod
    def read(cls, options: Mapping[str, str], run: FittedDrive | None) -> "Request":
        """Read the options, given as text by name; without a run they choose the drive.

        Raises:
            ConfigError: An option is missing, unknown or invalid.
        """
        remaining = dict(options)
        plan, noise, search = _take(Plan, remaining), _take(SensorNoise, remaining), _take(SearchOptions, remaining)
        limits = {name: _parse(name, remaining.pop(name)) for name in (*LIMITS, "home") if name in remaining}
        for name in LIMITS:
            if name not in limits:
                raise ConfigError(f"{name} is missing; state what the drive may do: position=1.5 velocity=4 torque=2")
        inputs = {name: read_number(name, remaining.pop(name)) for name in [*remaining] if name.startswith(_INPUTS)}
        named = {name.removeprefix(_INPUTS): value for name, value in inputs.items()}
        return cls(plan, noise, search, limits, named, _settle(remaining, run))


def _settle(options: Mapping[str, str], run: FittedDrive | None) -> dict[str, Any]:
    """Return the settings of the run, or of the chosen configuration files, with these options applied."""
    chosen = {name: value for name, value in options.items() if name in _GROUPS}
    names = [field.name for part in (Plan, SensorNoise, SearchOptions) for field in fields(part)]
    for name in options:
        if name not in _GROUPS and not f"{name}.".startswith(tuple(f"{option}." for option in _OF_A_RUN)):
            raise ConfigError(
                f"{name}: unknown option; {closest(name, [*LIMITS, 'home', *names, *_OF_A_RUN, 'output'])}"
            )
    for group, name in chosen.items():
        if run is not None:
            raise ConfigError(f"{group}={name}: {run.place} has chosen it; leave it out")
        if name not in list_choices(group):
            raise ConfigError(f"{group}={name}: unknown; {closest(name, list_choices(group))}")
    if run is None:
        plain = compose_config(*(f"{g}={n}" for g, n in chosen.items()))
        OmegaConf.set_struct(plain, False)
    else:
        plain = create_literal(keep_caches_at_home(run.result.settings))
    settings = resolve(override(plain, {name: value for name, value in options.items() if name not in chosen}))
    if run is None and "segments.length" not in options:
        settings["segments"]["length"] = None
    return {**settings, "model": complete_laws(settings["model"], settings)}


def _take(part: type[Part], options: dict[str, str]) -> Part:
    """Read a part of the request and remove its options from `options`."""
    arguments = {}
    for field in fields(part):
        if field.name in options:
            text, kind = options.pop(field.name), cast(type, field.type)
            arguments[field.name] = text if kind is str else read_number(field.name, text, kind)
    return part(**arguments)


def _parse(name: str, text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ConfigError(f"{name}={text}: cannot be read, expected a number or a list; close brackets") from None
