"""Friction as a neural network that knows no preferred direction."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from frictionzoo.models.network import NetworkModel, network_inputs
from frictionzoo.models.registry import register_model
from frictionzoo.types import DriveState, FrictionTerms


@register_model("odd_network")
class OddNetwork(NetworkModel):
    """A neural network made odd: the mirrored motion has the mirrored friction.

    torque = s (N(x / n) - N(-x / n)) / 2,  x = (q, v, a, tau_e)

        q      joint position [rad or m]
        v      joint velocity [rad/s or m/s]
        a      command of the joint's actuator, in the actuator's unit
        tau_e  external torque [N m or N]
        N      multilayer perceptron; the joints share it, and each is seen alone. The bias of its last layer cancels
        n      input_std, root mean square of each input in the training data, about 0: a mean would be a preferred
               side; x / n is held within 5
        s      torque_scale [N m or N], standard deviation of the actuator's torque in the training data

    Guarantees, whatever finite weights a fit finds:

        friction(-q, -v, -a, -tau_e) = -friction(q, v, a, tau_e), to the last bit where a batch is evaluated again with
            all signs changed: both sides are half the difference of the same two numbers, in turn.
        torque = 0 where q, v, a and tau_e are 0.
        Far outside the training data, torque is constant.

    The symmetry is that of a joint turned around its position 0, as seen from the other side. A drive has it where
    nothing in it tells one direction from the other, and load and position mirror about 0: a pendulum about the
    vertical, a carriage about its middle, with symmetric teeth, seals and windings. It halves what has to be learned.
    A drive lacks it where friction differs by direction (worm gears, one-sided springs or belts, an offset of the
    motor's current), where position 0 is no place of symmetry, or where friction over the position does not mirror
    about it, as ripple of any phase.

    Cannot represent: friction that differs by direction, sticking, friction with a memory, coupling between joints. It
    may give energy to the drive, and takes up any other odd error of the simulation.

    Source: equation of this package: the odd part of a function, as in any text on Fourier series; the network's inputs
    are those of V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "NeuralFriction".

    Args:
        nv: Number of joints.
        hidden: Width of each hidden layer.
        seed: Of the initial weights; torch's global generator is not touched.

    Raises:
        ConfigError: A width is below 1.
    """

    def __init__(self, nv: int, hidden: Sequence[int], seed: int) -> None:
        super().__init__(nv, hidden, 1, seed)

    def prepare(self, samples: DriveState) -> None:
        """Take the scales from the training data, and no mean.

        Args:
            samples: Training samples as numpy arrays of shape (samples, nv).
        """
        super().prepare(samples)
        sizes = [float(np.sqrt(np.mean(np.square(signal)))) or 1.0 for signal in network_inputs(samples)]
        self.input_mean.zero_()
        self.input_std.copy_(torch.tensor(sizes))

    def terms(self, xp: Any, values: Mapping[str, Any], state: DriveState) -> FrictionTerms:
        """The explicit torque."""
        x = self.bounded(xp, values, state)
        # The difference before any factor: compiled, a factor may be fused with one side of it and round apart.
        difference = self.network(xp, values, x) - self.network(xp, values, -x)
        return FrictionTerms(torque=0.5 * values["torque_scale"] * difference[..., 0])
