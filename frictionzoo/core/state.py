"""Signals that drive a simulation, the state that a friction model reads, and the terms that it returns."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple


class Signals(NamedTuple):
    """Recorded signals that drive a simulation, each of shape (..., nv), in any array library.

    Attributes:
        ctrl: Command of each joint's actuator.
        inputs: Further signals for the actuator law (gain, supply), by name.
        observed: Further signals that the friction model reads (temperature), by name.
    """

    ctrl: Any
    inputs: dict[str, Any] = {}
    observed: dict[str, Any] = {}

    def map(self, change: Callable[[Any], Any]) -> "Signals":
        """Apply a function to each signal and keep the names."""
        named = ({name: change(signal) for name, signal in part.items()} for part in self[1:])
        return Signals(change(self.ctrl), *named)

    def named(self) -> dict[str, Any]:
        """Return the signals by full name: `ctrl`, `inputs.NAME`, `observed.NAME`."""
        parts = (("inputs", self.inputs), ("observed", self.observed))
        return {"ctrl": self.ctrl} | {
            f"{part}.{name}": signal for part, group in parts for name, signal in group.items()
        }

    @classmethod
    def from_named(cls, arrays: Mapping[str, Any]) -> "Signals":
        """Pick the signals from arrays by full name."""
        inputs, observed = (
            {name.removeprefix(part): array for name, array in arrays.items() if name.startswith(part)}
            for part in ("inputs.", "observed.")
        )
        return cls(arrays["ctrl"], inputs, observed)


class DriveState(NamedTuple):
    """State that a friction model may read, each of shape (..., nv), in numpy, torch or JAX.

    Attributes:
        qpos: Joint position [rad or m].
        qvel: Joint velocity [rad/s or m/s].
        ctrl: Command of the joint's actuator.
        motor_torque: Torque or force of the joint's actuator [N m or N].
        external_torque: Torque or force of everything except actuator and friction: gravity, springs, payload, Coriolis
            [N m or N]; the paper's tau_e.
        temperature: Recorded temperature of the drive [degC]; None unless it is among the model's `inputs`.
    """

    qpos: Any
    qvel: Any
    ctrl: Any
    motor_torque: Any
    external_torque: Any
    temperature: Any = None

    def given(self) -> dict[str, Any]:
        """Return the signals that are present, by name."""
        return {name: signal for name, signal in self._asdict().items() if signal is not None}

    def map(self, change: Callable[[Any], Any]) -> "DriveState":
        """Apply a function to each signal that is present."""
        return self._replace(**{name: change(signal) for name, signal in self.given().items()})


class FrictionTerms(NamedTuple):
    """Terms that a friction model returns, each of shape (..., nv), or None if unused.

    Attributes:
        torque: Explicit friction torque [N m or N], subtracted from the drive torque; positive against positive qvel.
        frictionloss: Limit of MuJoCo's dry-friction constraint [N m or N]. Strictly positive: at 0 the joint locks.
        damping: MuJoCo's joint damping [N m s/rad or N s/m].
    """

    torque: Any = None
    frictionloss: Any = None
    damping: Any = None

    def given(self) -> dict[str, Any]:
        """Return the terms that the model uses, by name."""
        return {name: term for name, term in self._asdict().items() if term is not None}
