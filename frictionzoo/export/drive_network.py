"""A joint's drive as a function of recent position errors and velocities: delay, controller, motor and network."""

import copy
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.export.motor import Motor
from frictionzoo.models.actuator_network import ActuatorNetwork
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

    def __init__(self, motor: Motor, law: ActuatorNetwork, timestep: float, delay: float, offset: float) -> None:
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

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the torque [N m or N]."""
        linear, (stall, largest) = torch.nn.functional.linear, self.limits
        torque: Any = linear(x, self.wanted)
        if np.isfinite(stall):
            torque = torque.clamp(-stall, stall) - linear(x, self.falling)
        if np.isfinite(largest):
            torque = torque.clamp(-largest, largest)
        torque = torque + self.offset
        inputs = linear(torque, self.from_torque, self.shift) + linear(x, self.from_velocity)
        share = self.network(inputs.clamp(-SPAN, SPAN)).tanh()
        return linear(torque, self.newest) - linear(share, self.limit)


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
