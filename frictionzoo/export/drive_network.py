"""A joint's drive as a function of recent position errors and velocities: delay, controller, motor and network."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.export.motor import Motor
from frictionzoo.models.actuator_lstm import ActuatorLSTM
from frictionzoo.models.actuator_network import ActuatorModel
from frictionzoo.models.network import SPAN


class DriveNetwork(torch.nn.Module):
    """Torque of a joint's drive without its armature and MuJoCo's joint friction, in 32 bits.

    Inputs are the position errors (command minus position) of `steps` simulation steps, the newest first, then the
    velocities, of shape (batch, 2 steps); the output has the shape (batch, 1). All parts are products of matrices,
    clips, ReLU and tanh, which all runtimes have.

    A command that acts j steps late is recovered from the inputs: the error of step j, minus the distance that the
    joint has moved since then, which is the sum of its velocities times the step in a semi-implicit simulation.

    Attributes:
        steps: Number of steps in the inputs.
    """

    wanted: torch.Tensor
    falling: torch.Tensor
    from_torque: torch.Tensor
    from_velocity: torch.Tensor
    shift: torch.Tensor
    offset: torch.Tensor
    newest: torch.Tensor
    limit: torch.Tensor

    def __init__(self, motor: Motor, law: ActuatorModel, timestep: float, delay: float, offset: float) -> None:
        super().__init__()
        lag, late = int(np.ceil(delay / timestep - 1e-9)), delay / timestep
        share = lag - late  # of the command that is one step newer
        self.steps: int = law.history[-1] + lag + 1
        error, velocity = np.zeros((2, len(law.history), 2 * self.steps))
        for row, step in enumerate(law.history):
            velocity[row, self.steps + step] = 1
            for newer, weight in ((0, 1 - share), (1, share)):
                if weight:
                    end = step + lag - newer
                    error[row, end] += weight
                    error[row, self.steps + step : self.steps + end] -= weight * timestep
        mean, std = law.input_mean.numpy(), law.input_std.numpy()
        from_torque, from_velocity = np.zeros((2, 2 * len(law.history), len(law.history)))
        from_torque[::2], from_velocity[1::2] = np.eye(len(law.history)) / std[0], np.eye(len(law.history)) / std[1]
        falling = motor.saturation_effort / motor.velocity_limit if np.isfinite(motor.saturation_effort) else 0.0
        matrices = {
            "wanted": motor.stiffness * error - motor.damping * velocity + falling * velocity,
            "falling": falling * velocity,
            "from_torque": from_torque,
            "from_velocity": from_velocity @ velocity,
            "shift": np.tile(-mean / std, len(law.history)),
            "offset": np.full(len(law.history), offset),
            "newest": np.eye(len(law.history))[:1],
            "limit": np.array([[float(law.residual_limit * law.torque_scale)]]),
        }
        for name, matrix in matrices.items():
            self.register_buffer(name, torch.tensor(matrix, dtype=torch.float32))
        layers = [copy.deepcopy(layer).float() for layer in law.layers]
        self.network: torch.nn.Sequential = torch.nn.Sequential(
            *[part for layer in layers for part in (layer, torch.nn.ReLU())][:-1]
        )
        self.limits: tuple[float, float] = (motor.saturation_effort, motor.effort_limit)
        self.requires_grad_(False).eval()

    @property
    def example(self) -> dict[str, Any]:
        """Inputs of the right shape, by name."""
        return {"x": torch.zeros(2, 2 * self.steps)}

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the torque [N m or N]."""
        torque, inputs = self.run_motor(x)
        return self.run_network(torque, inputs)

    def run_motor(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the motor's torque [N m or N] in the steps of the law's history, and the inputs of its network."""
        linear, (stall, largest) = torch.nn.functional.linear, self.limits
        torque: Any = linear(x, self.wanted)
        if np.isfinite(stall):
            torque = torque.clamp(-stall, stall) - linear(x, self.falling)
        if np.isfinite(largest):
            torque = torque.clamp(-largest, largest)
        torque = torque + self.offset
        inputs = linear(torque, self.from_torque, self.shift) + linear(x, self.from_velocity)
        return torque, inputs.clamp(-SPAN, SPAN)

    def run_network(self, torque: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """Return the motor's present torque minus the network's [N m or N]."""
        linear = torch.nn.functional.linear
        return linear(torque, self.newest) - linear(self.network(inputs).tanh(), self.limit)


State = tuple[torch.Tensor, torch.Tensor]
"""Outputs and cells of an LSTM, each of shape (1, batch, units)."""


class RecurrentDriveNetwork(torch.nn.Module):
    """`DriveNetwork` with an LSTM, as Isaac Lab's `ActuatorNetLSTM` calls it.

    Inputs are position error and velocity, of shape (batch, 1, 2), and the LSTM's state; outputs are the torque, of
    shape (batch, 1), and the next state. The state is the law's memory and, for a delayed command, the position errors
    (with the outputs) and velocities (with the cells) of earlier steps, in units without weights.

    Attributes:
        steps: Number of steps from whose errors and velocities the motor's torque follows.
    """

    def __init__(self, drive: DriveNetwork, law: ActuatorLSTM) -> None:
        super().__init__()
        self.drive: DriveNetwork = drive
        self.units: int = law.units
        self.steps: int = drive.steps
        size = law.units + drive.steps - 1
        # On the meta device, because the constructor would use the global generator.
        self.lstm: torch.nn.LSTM = torch.nn.LSTM(2, size, batch_first=True, device="meta").to_empty(device="cpu")
        parts, forget = dict(self.lstm.named_parameters()), (law.forget.weight, law.forget.bias)
        outputs = zip(law.gates.weight.split(law.units), law.gates.bias.split(law.units), strict=True)
        with torch.no_grad():
            for part in parts.values():
                part.zero_()
            for gate, (weight, bias) in enumerate(((-forget[0], -forget[1]), forget, *outputs)):
                rows = slice(gate * size, gate * size + law.units)
                parts["weight_ih_l0"][rows], parts["bias_ih_l0"][rows] = weight[:, :2], bias
                parts["weight_hh_l0"][rows, : weight.shape[1] - 2] = weight[:, 2:]
        self.requires_grad_(False).eval()

    @property
    def example(self) -> dict[str, Any]:
        """See `DriveNetwork.example`."""
        return {"x": torch.zeros(2, 1, 2), "state": 2 * (torch.zeros(1, 2, self.lstm.hidden_size),)}

    def forward(self, x: torch.Tensor, state: State) -> tuple[torch.Tensor, State]:
        """Return the torque [N m or N] and the next state."""
        errors, velocities = (part[0, :, self.units :] for part in state)
        window = torch.cat([x[:, 0, :1], errors, x[:, 0, 1:], velocities], 1)
        torque, inputs = self.drive.run_motor(window)
        outputs, cells = (part[0, :, : self.units] for part in self.lstm(inputs[:, None], state)[1])
        torque = self.drive.run_network(torque, torch.cat([outputs, inputs], 1))
        return torque, self._pack(outputs, cells, window, 0)

    def settle(self, window: torch.Tensor) -> State:
        """Return the state before the newest step of a window (batch, 2 steps), as if the window had long lasted."""
        inputs = self.drive.run_motor(window)[1]
        weight, bias = (self.lstm.get_parameter(f"{name}_ih_l0") for name in ("weight", "bias"))
        gates = torch.nn.functional.linear(inputs, weight, bias).chunk(4, 1)
        candidate, output = (gate[:, : self.units] for gate in gates[2:])
        return self._pack(output.sigmoid() * candidate.tanh().tanh(), candidate.tanh(), window, 1)

    def _pack(self, outputs: torch.Tensor, cells: torch.Tensor, window: torch.Tensor, first: int) -> State:
        errors, velocities = (part[:, first : first + self.steps - 1] for part in window.split(self.steps, 1))
        return torch.cat([outputs, errors], 1)[None], torch.cat([cells, velocities], 1)[None]


class Recurrence:
    """A loaded `RecurrentDriveNetwork` with its state, called as a `DriveNetwork` once a step."""

    def __init__(self, run: Callable[..., tuple[torch.Tensor, State]], network: RecurrentDriveNetwork) -> None:
        self._run, self._network = run, network
        self.state: State | None = None

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """Return the torque for errors and velocities of shape (batch, 2 steps); without a state, start settled."""
        state = self._network.settle(x) if self.state is None else self.state
        torque, self.state = self._run(x[:, [0, self._network.steps]][:, None], state)
        return torque


class History:
    """Recent position errors and velocities of joints, as Isaac Lab, mjlab and Newton keep them."""

    def __init__(self, errors: Float[np.ndarray, "steps nv"], velocities: Float[np.ndarray, "steps nv"]) -> None:
        self._rows = np.stack([errors, velocities])

    def push(self, error: Float[np.ndarray, "nv"], velocity: Float[np.ndarray, "nv"]) -> None:
        """Add the newest step and forget the oldest."""
        self._rows = np.concatenate([np.stack([error, velocity])[:, None], self._rows[:, :-1]], axis=1)

    def read(self, steps: int, joints: tuple[int, ...]) -> torch.Tensor:
        """Return the inputs of a network for these joints, of shape (joints, 2 steps), in 32 bits."""
        picked = self._rows[:, :steps][:, :, list(joints)]
        return torch.tensor(picked.transpose(2, 0, 1).reshape(len(joints), -1), dtype=torch.float32)
