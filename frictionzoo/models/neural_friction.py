"""Friction as a small neural network."""

from collections.abc import Sequence
from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Values, register_model
from frictionzoo.models.network import NetworkModel


@register_model("neural_friction")
class NeuralFriction(NetworkModel):
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
    """

    def __init__(self, nv: int, hidden: Sequence[int] = (64, 64), seed: int = 0) -> None:
        super().__init__(nv, hidden, 1, seed)

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The explicit torque."""
        answer = self.network(xp, values, self.normalised(xp, values, state))
        return FrictionTerms(torque=values["torque_scale"] * answer[..., 0])
