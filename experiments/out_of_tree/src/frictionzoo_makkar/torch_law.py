"""Viscous friction and a network whose layers exist only in torch."""

from typing import Any

import numpy as np
import torch

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Parameter, Params, TorchFriction, register_model


@register_model("layer_norm_network")
class LayerNormNetwork(TorchFriction):
    """Viscous friction, and a network with layer normalisation for the residual torque.

    torque = d v + s N(x),  x = (q, v, a, tau_e) over their root mean square in the training data

        v      joint velocity [rad/s or m/s]
        d      viscous_coefficient [N m s/rad or N s/m]
        s      standard deviation of the actuator's torque in the training data [N m or N]
        q      joint position [rad or m]
        a      command, in the actuator's unit
        tau_e  torque of everything except actuator and friction [N m or N]

    N is a linear layer, layer normalisation, the activation GELU, and a linear layer; it starts near zero.

    Cannot represent: sticking, memory, coupling between joints. It can add energy to the drive. The network can take
    over the torque of d, and d the torque of the network.

    Source: J. L. Ba, J. R. Kiros, G. E. Hinton, "Layer Normalization", 2016; D. Hendrycks, K. Gimpel, "Gaussian Error
    Linear Units (GELUs)", 2016; the sum is this example's.

    Args:
        nv: Number of joints.
        width: Width of the hidden layer.
        seed: Seed of the initial weights.
        params: Settings of each physical parameter.
    """

    physical_parameters = {"viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10)}
    viscous_coefficient: torch.Tensor
    input_size: torch.Tensor
    torque_scale: torch.Tensor

    def __init__(self, nv: int, width: int = 16, seed: int = 0, params: Params | None = None) -> None:
        super().__init__(nv, params)
        with torch.random.fork_rng():  # leave torch's global generator unchanged
            torch.manual_seed(seed)
            last = torch.nn.Linear(width, 1)
            self.network = torch.nn.Sequential(
                torch.nn.Linear(4, width), torch.nn.LayerNorm(width), torch.nn.GELU(), last
            )
        with torch.no_grad():
            last.weight.mul_(0.01)
            last.bias.zero_()
        # Buffers, because a saved state must contain these values from the data.
        self.register_buffer("input_size", torch.ones(4))
        self.register_buffer("torque_scale", torch.ones(()))

    def prepare(self, samples: DriveState) -> None:
        """Take the normalisation from the training data."""
        sizes = [float(np.sqrt(np.mean(np.square(signal)))) or 1.0 for signal in _inputs(samples)]
        self.input_size.copy_(torch.tensor(sizes))
        self.torque_scale.fill_(float(np.std(samples.motor_torque)) or 1.0)

    def forward(self, state: DriveState) -> FrictionTerms:
        """Return the explicit torque."""
        seen = torch.stack(_inputs(state), dim=-1) / self.input_size
        learned = self.torque_scale * self.network(seen).squeeze(-1)
        return FrictionTerms(torque=self.viscous_coefficient * state.qvel + learned)


def _inputs(state: DriveState) -> list[Any]:
    return [state.qpos, state.qvel, state.ctrl, state.external_torque]
