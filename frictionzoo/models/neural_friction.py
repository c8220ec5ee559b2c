"""Friction as a small neural network."""

from collections.abc import Sequence
from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Values, register_model
from frictionzoo.models.network import NetworkModel


@register_model("neural_friction")
class NeuralFriction(NetworkModel):
    """Multilayer perceptron of position, velocity, command and external torque.

    Use it if no formula is known; `dissipative_network`, `odd_network` and `residual_network` have guarantees.

    Cannot represent: friction with a memory, sticking, coupling between joints. It does not extrapolate outside the
    training data, may add energy to the drive, and absorbs any other error of the simulation.

    torque = s MLP((x - m) / n),  x = (q, v, a, tau_e)

        q      joint position [rad or m]
        v      joint velocity [rad/s or m/s]
        a      command of the joint's actuator, in the actuator's unit
        tau_e  external torque [N m or N]
        m, n   input_mean and input_std, mean and standard deviation of each input in the training data
        s      torque_scale [N m or N], standard deviation of the actuator torque in the training data

    The activation is ReLU. The joints share the weights, and each joint is evaluated alone. m, n and s are saved with
    the weights, so a saved model is complete.

    Source: V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "NeuralFriction".
    """

    def __init__(self, nv: int, hidden: Sequence[int] = (64, 64), seed: int = 0) -> None:
        super().__init__(nv, hidden, 1, seed)

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the explicit torque."""
        answer = self.network(xp, values, self.normalised(xp, values, state))
        return FrictionTerms(torque=values["torque_scale"] * answer[..., 0])
