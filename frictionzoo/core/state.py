"""What drives a simulation, the state that a friction law sees, and the terms it answers with."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple


class Signals(NamedTuple):
    """What was recorded besides the state and drives a simulation, each of shape (..., nv), in any array library.

    Attributes:
        ctrl: Command of each joint's actuator.
        inputs: What the actuator law needs besides it (gain, supply), by name.
        observed: What the friction law looks at besides the state (temperature), by name.
    """

    ctrl: Any
    inputs: dict[str, Any] = {}
    observed: dict[str, Any] = {}

    def map(self, change: Callable[[Any], Any]) -> "Signals":
        """Each signal changed, under the same names.

        Args:
            change: From a signal to what takes its place.
        """
        named = ({name: change(signal) for name, signal in part.items()} for part in self[1:])
        return Signals(change(self.ctrl), *named)

    def named(self) -> dict[str, Any]:
        """The signals by full name: `ctrl`, `inputs.NAME`, `observed.NAME`."""
        parts = (("inputs", self.inputs), ("observed", self.observed))
        return {"ctrl": self.ctrl} | {f"{part}.{name}": signal for part, of in parts for name, signal in of.items()}

    @classmethod
    def from_named(cls, arrays: Mapping[str, Any]) -> "Signals":
        """The signals among arrays by full name."""
        inputs, observed = (
            {name.removeprefix(part): array for name, array in arrays.items() if name.startswith(part)}
            for part in ("inputs.", "observed.")
        )
        return cls(arrays["ctrl"], inputs, observed)


class DriveState(NamedTuple):
    """What a friction law may look at, each of shape (..., nv), in numpy, torch or JAX alike.

    Attributes:
        qpos: Joint position [rad or m].
        qvel: Joint velocity [rad/s or m/s].
        ctrl: Command of the joint's actuator.
        motor_torque: Torque or force of the joint's actuator [N m or N].
        external_torque: Torque or force of everything but actuator and friction: gravity, springs, payload, Coriolis
            [N m or N]; the paper's tau_e.
        temperature: Recorded temperature of the drive [degC]; None unless the law has it among its `inputs`.
    """

    qpos: Any
    qvel: Any
    ctrl: Any
    motor_torque: Any
    external_torque: Any
    temperature: Any = None

    def given(self) -> dict[str, Any]:
        """The signals that are there, by name."""
        return {name: signal for name, signal in self._asdict().items() if signal is not None}

    def map(self, change: Callable[[Any], Any]) -> "DriveState":
        """The state with each signal that is there changed."""
        return self._replace(**{name: change(signal) for name, signal in self.given().items()})


class FrictionTerms(NamedTuple):
    """A friction law's answer, each of shape (..., nv) or None where the law does not use it.

    Attributes:
        torque: Explicit friction torque [N m or N], subtracted from the drive torque; positive against positive qvel.
        frictionloss: Limit of MuJoCo's own dry-friction constraint [N m or N]. Strictly positive: at 0 the joint locks.
        damping: MuJoCo's own joint damping [N m s/rad or N s/m].
    """

    torque: Any = None
    frictionloss: Any = None
    damping: Any = None

    def given(self) -> dict[str, Any]:
        """The terms that the law uses, by name."""
        return {name: term for name, term in self._asdict().items() if term is not None}
