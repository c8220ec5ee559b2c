"""Base classes of models with a neural network: the network, its inputs and their normalisation."""

import itertools
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState
from frictionzoo.models.base import FrictionModel, Params, Values

INPUTS = 4
OCTAVES = (1, 2, 4, 8)  # rad of phase per standard deviation of the position
MOST_WIDTH, MOST_LAYERS = 4096, 32  # largest hidden layers; those of the models are a hundred times smaller
SPAN = 5.0  # standard deviations of the training data at which inputs are clipped


class NetworkModel(FrictionModel):
    """Model with a multilayer perceptron of signals of the drive, with ReLU between its linear layers.

    The joints share the weights, and each joint is evaluated alone. The normalisation is saved with the weights, so a
    saved model is complete.

    Attributes:
        columns: Number of network inputs per joint.
        count: Number of signals.
        input_mean: Mean of each signal in the training data.
        input_std: Standard deviation of each signal in the training data; 1 for a constant signal.
        torque_scale: Standard deviation of the actuator torque in the training data [N m or N]; 1 if it is constant.

    Args:
        hidden: Width of each hidden layer.
        outputs: Number of network outputs.
        seed: Seed of the initial weights; torch's global generator stays unchanged.

    Raises:
        ConfigError: A width or the number of layers is out of bounds; see also `FrictionModel`.
    """

    sees: ClassVar[tuple[str, ...]] = ("speed", "slow", "fast", "direction", "load", "position")
    columns: int = INPUTS
    count: ClassVar[int] = INPUTS
    input_mean: torch.Tensor
    input_std: torch.Tensor
    torque_scale: torch.Tensor

    def __init__(self, nv: int, hidden: Sequence[int], outputs: int, seed: int, params: Params | None = None) -> None:
        super().__init__(nv, params)
        if not all(1 <= width <= MOST_WIDTH for width in hidden) or len(hidden) > MOST_LAYERS:
            raise ConfigError(
                f"model.hidden={list(hidden)}; expected widths of at least 1 and at most {MOST_WIDTH}, and at most "
                f"{MOST_LAYERS} of them"
            )
        generator = torch.Generator().manual_seed(seed)
        widths = [self.columns, *hidden, outputs]
        layers = (draw_linear(*pair, generator) for pair in itertools.pairwise(widths))
        self.layers: torch.nn.ModuleList = torch.nn.ModuleList(layers)
        with torch.no_grad():
            for weights in self.layers[-1].parameters():
                # Start near zero, but not at zero, where the other layers have no gradient.
                weights.copy_(0.01 * weights)
        self.register_buffer("input_mean", torch.zeros(self.count, dtype=torch.float64))
        self.register_buffer("input_std", torch.ones(self.count, dtype=torch.float64))
        self.register_buffer("torque_scale", torch.ones((), dtype=torch.float64))

    def signals(self, state: DriveState) -> list[Any]:
        """Return the signals for the network, in the order of `input_mean`."""
        return [state.qpos, state.qvel, state.ctrl, state.external_torque]

    def prepare(self, samples: DriveState) -> None:
        """Take the normalisation from the training data, once: weights are valid for one normalisation only."""
        if (self.input_mean == 0).all() and (self.input_std == 1).all() and self.torque_scale == 1:
            mean, std = zip(*self.normalise(samples), strict=True)
            self.input_mean.copy_(torch.tensor(mean))
            self.input_std.copy_(torch.tensor(std))
            self.torque_scale.fill_(_mean_and_std(samples.motor_torque)[1])

    def normalise(self, samples: DriveState) -> list[tuple[float, float]]:
        """Return mean and standard deviation of each signal; training data have shape (samples, nv)."""
        return [_mean_and_std(signal) for signal in self.signals(samples)]

    def normalised(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the signals minus their mean, over their standard deviation, of shape (..., nv, inputs)."""
        return (xp.stack(self.signals(state), -1) - values["input_mean"]) / values["input_std"]

    def bounded(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return normalised signals clipped at `SPAN`: far outside the training data the network is constant."""
        return xp.clip(self.normalised(xp, values, state), -SPAN, SPAN)

    def network(self, xp: Any, values: Values, x: Any) -> Any:
        """Return the network's output, of shape (..., outputs), for inputs of shape (..., inputs)."""
        for layer in range(len(self.layers)):
            if layer:  # not maximum(x, 0), whose gradient at 0 is 1/2; here it is 0, and NaN propagates
                x = xp.where(x <= 0, 0.0, x)
            x = xp.matmul(x, values[f"layers.{layer}.weight"].T) + values[f"layers.{layer}.bias"]
        return x


class GearNetwork(NetworkModel):
    """Model with a network of the signals that affect gear friction.

    Its inputs are the actuator torque instead of the command, and sines and cosines of the position in addition to the
    position. A network of the position alone learns slow changes first, and the effect of meshing gears last or never.

    Source: M. Tancik et al., "Fourier Features Let Networks Learn High Frequency Functions in Low Dimensional Domains",
    NeurIPS 2020.
    """

    columns: int = INPUTS + 2 * len(OCTAVES)

    def signals(self, state: DriveState) -> list[Any]:
        """See `NetworkModel.signals`."""
        return [state.qpos, state.qvel, state.motor_torque, state.external_torque]

    def bounded(self, xp: Any, values: Values, state: DriveState) -> Any:
        """See `NetworkModel.bounded`; appends sines, then cosines of the position."""
        x = xp.clip(self.normalised(xp, values, state), -SPAN, SPAN)
        phases = [octave * x[..., :1] for octave in OCTAVES]
        return xp.concatenate([x, *map(xp.sin, phases), *map(xp.cos, phases)], -1)


def reverse(state: DriveState) -> DriveState:
    """Return the state with reversed motion and load at the same position; the command stays."""
    return state._replace(qvel=-state.qvel, motor_torque=-state.motor_torque, external_torque=-state.external_torque)


def sigmoid(xp: Any, x: Any) -> Any:
    """Return 1 / (1 + exp(-x)); torch and jax.numpy share only tanh."""
    return 0.5 * (1 + xp.tanh(0.5 * x))


def draw_linear(inputs: int, outputs: int, generator: torch.Generator) -> torch.nn.Linear:
    """Return a linear layer with PyTorch's usual initial distribution, drawn from this generator."""
    # On the meta device, because the constructor would use the global generator.
    layer = torch.nn.Linear(inputs, outputs, device="meta", dtype=torch.float64).to_empty(device="cpu")
    for weights in layer.parameters():
        torch.nn.init.uniform_(weights, -(inputs**-0.5), inputs**-0.5, generator=generator)
    return layer


def _mean_and_std(signal: Float[np.ndarray, "samples nv"]) -> tuple[float, float]:
    """Return mean and standard deviation; 1 as deviation if the signal is constant except for rounding."""
    mean, std = float(np.mean(signal)), float(np.std(signal))
    constant = std <= 1e-9 * float(np.max(np.abs(signal)))
    return mean, 1.0 if constant else std
