"""Default data set: simulation of the paper's bench with known true parameters."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, LogError, closest, refuse_outside
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.segments import split_by_time
from frictionzoo.data.cache import cache_folder, cached, digest
from frictionzoo.data.signals import Signal
from frictionzoo.data.source import Source, register_source

FORMAT = 1  # increase with every change of the simulation to invalidate older caches
MOST_STEPS = 100_000_000  # of a simulation, about ten minutes
States = Float[np.ndarray, "time nv"]
Part = TypeVar("Part", bound=Any)  # any dataclass
DIVERGED = 1e6  # implausible torque [N m]; above 1e10 MuJoCo would reset the state and continue
SIGNALS = ("time", "qpos", "qvel", "ctrl")
MOST_HARMONICS = 1000


def refuse_low(section: str, part: Any, above_zero: Sequence[str] = (), from_zero: Sequence[str] = ()) -> None:
    """Raise ConfigError for an attribute below its lower bound; the message names it within `data.SECTION`."""
    for name in (*above_zero, *from_zero):
        value, is_positive = getattr(part, name), name in above_zero
        if not (value > 0 if is_positive else value >= 0):
            expected = "a positive number" if is_positive else "0 or more"
            raise ConfigError(f"data.{section}.{name}={value:g}: expected {expected}")


@dataclass(frozen=True)
class Excitation:
    """The paper's excitation, v_des = sum of A_k sin(w_k t + phi_k), clipped; the command q_des is its integral.

    Attributes:
        harmonics: Number of terms.
        amplitude: Range of A_k [rad/s].
        frequency: Range of w_k [rad/s].
        phase: Range of phi_k [rad].
        velocity_limit: Largest speed of v_des [rad/s].
    """

    harmonics: int
    amplitude: tuple[float, float]
    frequency: tuple[float, float]
    phase: tuple[float, float]
    velocity_limit: float

    def __post_init__(self) -> None:
        refuse_outside("data.excitation.harmonics", self.harmonics, 1, MOST_HARMONICS)
        for name in ("amplitude", "frequency", "phase"):
            low, high = getattr(self, name)
            if not low <= high:
                setting = f"data.excitation.{name}=[{low:g}, {high:g}]"
                raise ConfigError(f"{setting}: expected two numbers, the smaller first")
        refuse_low("excitation", self, above_zero=("velocity_limit",))

    def command(self, time: Signal, rng: np.random.Generator) -> Signal:
        """Return the desired position [rad] at these times [s].

        The clipped sum has a small mean, so its integral drifts over minutes; a fitted line is subtracted.
        """
        bounds = self.amplitude, self.frequency, self.phase
        amplitude, frequency, phase = (rng.uniform(low, high, self.harmonics) for low, high in bounds)
        terms = amplitude * np.sin(time[:, None] * frequency + phase)
        velocity = np.clip(terms.sum(axis=1), -self.velocity_limit, self.velocity_limit)
        position = np.concatenate([[0.0], np.cumsum((velocity[1:] + velocity[:-1]) / 2 * np.diff(time))])
        return position - np.polyval(np.polyfit(time, position, 1), time)


@dataclass(frozen=True)
class HiddenDrive:
    """Drive of the simulation, unknown to the identification.

    Friction torque = (coulomb_torque + (static_torque - coulomb_torque) exp(-(v / stribeck_velocity)^2)
    + load_share |tau| + ripple_torque sin(ripple_periods q)) tanh(v / smoothing_velocity) + viscous_coefficient v,
    where tau is the motor torque.

    Attributes:
        armature: Reflected inertia [kg m^2].
        coulomb_torque: Dry friction at high speed [N m].
        static_torque: Dry friction at low speed [N m].
        stribeck_velocity: Speed scale of the transition from static to Coulomb torque [rad/s].
        viscous_coefficient: Viscous friction coefficient [N m s/rad].
        smoothing_velocity: Speed scale of the sign change of dry friction [rad/s].
        load_share: Dry friction per motor torque, as in loaded gears.
        ripple_torque: Amplitude of the ripple of dry friction over position [N m].
        ripple_periods: Angular frequency of the ripple over position [rad/rad].
        command_delay: Delay from a command to its effect [s].
    """

    armature: float
    coulomb_torque: float
    static_torque: float
    stribeck_velocity: float
    viscous_coefficient: float
    smoothing_velocity: float
    load_share: float
    ripple_torque: float
    ripple_periods: float
    command_delay: float

    def __post_init__(self) -> None:
        refuse_low("drive", self, ("stribeck_velocity", "smoothing_velocity"), ("armature", "command_delay"))

    def friction(self, qpos: float, qvel: float, motor_torque: float) -> float:
        """Return friction torque [N m], positive at positive qvel [rad/s]; motor torque on the output side [N m]."""
        dry = (
            self.coulomb_torque
            + (self.static_torque - self.coulomb_torque) * math.exp(-((qvel / self.stribeck_velocity) ** 2))
            + self.load_share * abs(motor_torque)
            + self.ripple_torque * math.sin(self.ripple_periods * qpos)
        )
        return dry * math.tanh(qvel / self.smoothing_velocity) + self.viscous_coefficient * qvel


@dataclass(frozen=True)
class Controller:
    """Position controller of the drive, tau = kp (q_des - q) - kd v, with kp [N m/rad] and kd [N m s/rad]."""

    kp: float
    kd: float


@dataclass(frozen=True)
class Sensor:
    """Measurement errors of the sensors.

    Attributes:
        position_quantum: Step of the encoder [rad]; 0 for none.
        velocity_noise: Standard deviation of white noise on the velocity [rad/s].
    """

    position_quantum: float
    velocity_noise: float

    def __post_init__(self) -> None:
        refuse_low("sensor", self, from_zero=("position_quantum", "velocity_noise"))

    def measure(self, qpos: States, qvel: States, rng: np.random.Generator) -> tuple[States, States]:
        """Return measured position [rad] and velocity [rad/s]."""
        if self.position_quantum:
            qpos = np.round(qpos / self.position_quantum) * self.position_quantum
        return qpos, qvel + self.velocity_noise * rng.standard_normal(qvel.shape)


@register_source("twin")
class Twin(Source):
    """The paper's bench with a hidden drive, simulated in MuJoCo C; training and test data are blocks of one recording.

    The sections `excitation`, `controller`, `drive` and `sensor` have the attributes of `Excitation`, `Controller`,
    `HiddenDrive` and `Sensor`.

    Source: V. Kovalev et al., Proceedings of MIPT 18(2), 2026: bench, controller, excitation, length of the recording.

    Args:
        name: Name of the data set.
        seed: Seed of excitation and noise.
        samples: Number of samples of the recording.
        timestep: Sample interval [s].
        substeps: Simulation steps in a sample interval. Several keep the data from sharing a fit's integration error.
        mjcf: File name of a bench in the package, with one hinge.
        split: `test_share` and `gap` of `split_by_time`.
        cache_dir: See `cache_folder`.

    Raises:
        ConfigError: An option is missing, unknown or impossible.
    """

    hidden: ClassVar[type] = HiddenDrive
    drive: Any

    def __init__(
        self,
        name: str,
        seed: int,
        samples: int,
        timestep: float,
        substeps: int,
        mjcf: str,
        excitation: Mapping[str, Any],
        controller: Mapping[str, Any],
        drive: Mapping[str, Any],
        sensor: Mapping[str, Any],
        split: Mapping[str, Any],
        cache_dir: str | None,
    ) -> None:
        for option, value, low in (("samples", samples, 2), ("substeps", substeps, 1), ("seed", seed, 0)):
            if not isinstance(value, int) or value < low:
                raise ConfigError(f"data.{option}={value}: expected a whole number of {low} or more")
        if samples * substeps > MOST_STEPS:
            raise ConfigError(
                f"data.samples={samples} with data.substeps={substeps}: {samples * substeps:g} simulation steps, "
                f"expected at most {MOST_STEPS:g}; lower one of them"
            )
        if not timestep > 0:
            raise ConfigError(f"data.timestep={timestep}: expected a positive number of seconds")
        self.name, self.seed, self.split = name, seed, dict(split)
        self.samples, self.timestep, self.substeps = samples, timestep, substeps
        self.mjcf, self.cache_dir = _packaged_bench(mjcf), cache_folder(cache_dir)
        self.excitation = _section(Excitation, "excitation", excitation)
        self.controller = _section(Controller, "controller", controller)
        self.drive = _section(self.hidden, "drive", drive)
        self.sensor = _section(Sensor, "sensor", sensor)

    def load(self) -> Dataset:
        """Load the recording from the cache, or simulate it, and split it by time.

        Raises:
            LogError: The simulation diverges, or the split leaves a part empty.
        """
        arrays = cached(self.cache_file(), SIGNALS, self._record)
        metadata = {"controller": asdict(self.controller), "drive": asdict(self.drive), "seed": self.seed}
        time, qpos, qvel, ctrl = (arrays[name] for name in SIGNALS)
        units = {"qpos": "rad", "ctrl": "rad"}
        log = Log(self.name, time, qpos, qvel, ctrl, digest(arrays), simulated=True, metadata=metadata, units=units)
        train, test = split_by_time(log, **self.split)
        return Dataset(self.name, (train,), (test,))

    def cache_file(self) -> Path | None:
        """Return the cache file, named by a hash of all settings; None without a cache."""
        if self.cache_dir is None:
            return None
        settings = {
            "format": FORMAT,
            "mujoco": mujoco.__version__,
            "mjcf": self.mjcf,
            "seed": self.seed,
            "grid": [self.samples, self.timestep, self.substeps],
            "parts": [asdict(part) for part in (self.excitation, self.controller, self.drive, self.sensor)],
        }
        key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
        return self.cache_dir / f"{self.name}-{key}.npz"

    def _record(self) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(self.seed)
        time = np.arange(self.samples) * self.timestep
        ctrl = self.excitation.command(time, rng)
        qpos, qvel = self.simulate(ctrl)
        qpos, qvel = self.sensor.measure(qpos, qvel, rng)
        return {"time": time, "qpos": qpos, "qvel": qvel, "ctrl": ctrl[:, None]}

    def simulate(self, ctrl: Signal) -> tuple[States, States]:
        """Simulate true position [rad] and velocity [rad/s] at the samples, from rest at the first command.

        `ctrl` is the desired position at each sample [rad], held over the sample interval.

        Raises:
            LogError: The simulation diverges.
        """
        model = self._spec().compile()
        data = mujoco.MjData(model)
        data.qpos[:] = ctrl[0]
        states = np.empty((self.samples, 2))
        delay_steps = round(getattr(self.drive, "command_delay", 0.0) / model.opt.timestep)
        commands = ctrl.tolist()
        for sample in range(self.samples):
            states[sample] = data.qpos[0], data.qvel[0]
            for step in range(sample * self.substeps, (sample + 1) * self.substeps):
                command = commands[max(step - delay_steps, 0) // self.substeps]
                torques, largest = self._drive(data.qpos.tolist(), data.qvel.tolist(), command)
                if not largest < DIVERGED:
                    substep = self.timestep / self.substeps
                    raise LogError(
                        f"{self.name}: the simulation diverged at sample {sample}; expected a drive that is stable "
                        f"with steps of {substep:g} s; raise data.substeps, or lower data.timestep or the gains in "
                        "data.controller and data.drive"
                    )
                data.qfrc_applied[:] = torques
                mujoco.mj_step(model, data)
        return states[:, :1], states[:, 1:]

    def _drive(self, qpos: list[float], qvel: list[float], command: float) -> tuple[list[float], float]:
        """Return the torque on each joint, and the magnitude that shows divergence [N m]."""
        motor_torque = self.controller.kp * (command - qpos[0]) - self.controller.kd * qvel[0]
        torque = motor_torque - self.drive.friction(qpos[0], qvel[0], motor_torque)
        return [torque], abs(torque)

    def _spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_string(self.mjcf)
        spec.option.timestep = self.timestep / self.substeps
        spec.joints[0].armature = self.drive.armature
        return spec


def _section(part: type[Part], name: str, given: Mapping[str, Any]) -> Part:
    """Build a part from its section of the configuration; ConfigError if they do not match."""
    types = {field.name: field.type for field in fields(part)}
    for key in set(given) - set(types):
        raise ConfigError(f"data.{name}.{key}: unknown option; {closest(str(key), types)}")
    values: dict[str, Any] = {}
    for key, kind in types.items():
        if key not in given:
            raise ConfigError(f"data.{name}.{key}: missing; give {', '.join(types)}")
        is_number = kind in (int, float)
        try:
            if is_number:
                values[key] = kind(given[key])
            else:
                low, high = given[key]
                values[key] = float(low), float(high)
        except (TypeError, ValueError):
            expected = "a number" if is_number else "two numbers, [low, high]"
            raise ConfigError(f"data.{name}.{key}={given[key]}: expected {expected}") from None
    return part(**values)


def _packaged_bench(file_name: str) -> str:
    folder = resources.files("frictionzoo") / "bench" / "assets"
    available = sorted(entry.name for entry in folder.iterdir() if entry.name.endswith(".xml"))
    if file_name not in available:
        raise ConfigError(f"data.mjcf={file_name}: no such bench; {closest(file_name, available)}")
    return (folder / file_name).read_text(encoding="utf-8")
