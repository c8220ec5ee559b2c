"""Friction as a small neural network."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.errors import ConfigError
from frictionzoo.models.base import FrictionModel
from frictionzoo.models.registry import register_model
from frictionzoo.types import DriveState, FrictionTerms

INPUTS = 4  # qpos, qvel, ctrl, external_torque


@register_model("neural_friction")
class NeuralFriction(FrictionModel):
    """A multilayer perceptron of what the drive is doing.

    torque = s MLP((x - m) / n),  x = (q, v, a, tau_e)

        q      joint position [rad or m]
        v      joint velocity [rad/s or m/s]
        a      command of the joint's actuator, in the actuator's unit
        tau_e  external torque [N m or N]
        m, n   input_mean and input_std, mean and standard deviation of each input in the training data
        s      torque_scale [N m or N], standard deviation of the actuator's torque in the training data

    Between linear layers stands ReLU. The joints share the weights, and each is seen alone. m, n and s are kept with
    the weights, so that a saved model is complete.

    Cannot represent: friction with a memory, sticking, coupling between joints. It extrapolates without sense outside
    the training data, may give energy to the drive, and takes up any other error of the simulation.

    Source: V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "NeuralFriction".

    Args:
        nv: Number of joints.
        hidden: Width of each hidden layer.
        seed: Of the initial weights; torch's global generator is not touched.

    Raises:
        ConfigError: A width is below 1.
    """

    input_mean: torch.Tensor
    input_std: torch.Tensor
    torque_scale: torch.Tensor

    def __init__(self, nv: int, hidden: Sequence[int], seed: int) -> None:
        super().__init__(nv)
        if not all(width >= 1 for width in hidden):
            raise ConfigError(f"model.hidden={list(hidden)}; expected widths of at least 1")
        generator = torch.Generator().manual_seed(seed)
        widths = [INPUTS, *hidden, 1]
        self.layers = torch.nn.ModuleList(_linear(*pair, generator) for pair in itertools.pairwise(widths))
        with torch.no_grad():
            for weights in self.layers[-1].parameters():
                # Friction starts near zero, yet not at zero, where the other layers have no gradient.
                weights.copy_(0.01 * weights)
        self.register_buffer("input_mean", torch.zeros(INPUTS, dtype=torch.float64))
        self.register_buffer("input_std", torch.ones(INPUTS, dtype=torch.float64))
        self.register_buffer("torque_scale", torch.ones((), dtype=torch.float64))

    def prepare(self, samples: DriveState) -> None:
        """Take the normalisation from the training data.

        Args:
            samples: Training samples as numpy arrays of shape (samples, nv).
        """
        mean, std = zip(*(_mean_and_std(signal) for signal in _inputs(samples)), strict=True)
        self.input_mean.copy_(torch.tensor(mean))
        self.input_std.copy_(torch.tensor(std))
        self.torque_scale.fill_(_mean_and_std(samples.motor_torque)[1])

    def terms(self, xp: Any, values: Mapping[str, Any], state: DriveState) -> FrictionTerms:
        """The explicit torque."""
        x = (xp.stack(_inputs(state), -1) - values["input_mean"]) / values["input_std"]
        last = len(self.layers) - 1
        for layer in range(last + 1):
            x = xp.matmul(x, values[f"layers.{layer}.weight"].T) + values[f"layers.{layer}.bias"]
            if layer < last:
                # Not maximum(x, 0), whose gradient at a tie is 1/2; this one is 0 there and lets NaN through.
                x = xp.where(x <= 0, 0.0, x)
        return FrictionTerms(torque=values["torque_scale"] * x[..., 0])


def _inputs(state: DriveState) -> list[Any]:
    return [state.qpos, state.qvel, state.ctrl, state.external_torque]


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> torch.nn.Linear:
    """A linear layer with PyTorch's usual initial distribution, drawn from this generator."""
    # On the meta device, because the constructor would draw from the global generator.
    layer = torch.nn.Linear(inputs, outputs, device="meta", dtype=torch.float64).to_empty(device="cpu")
    for weights in layer.parameters():
        torch.nn.init.uniform_(weights, -(inputs**-0.5), inputs**-0.5, generator=generator)
    return layer


def _mean_and_std(signal: Float[np.ndarray, "samples nv"]) -> tuple[float, float]:
    """Mean and standard deviation; 1 instead of the deviation where the signal is constant but for rounding."""
    mean, std = float(np.mean(signal)), float(np.std(signal))
    constant = std <= 1e-9 * float(np.max(np.abs(signal)))
    return mean, 1.0 if constant else std
