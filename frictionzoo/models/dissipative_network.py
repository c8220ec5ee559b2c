"""Friction as a neural network that cannot drive the joint."""

from collections.abc import Sequence
from typing import Any

import torch

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Params, Values, register_model
from frictionzoo.models.network import GearNetwork

START = -3.0  # bias of both outputs at the start: softplus(-3) = 0.05


@register_model("dissipative_network")
class DissipativeNetwork(GearNetwork):
    """A neural network for the size of friction only; its direction is against the motion by construction.

    torque = s softplus(N_1(x)) tanh(v / v_0) + (s / n_v) softplus(N_2(x)) v,  x = (q, v, tau_m, tau_e)

        q      joint position [rad or m]
        v      joint velocity [rad/s or m/s]
        tau_m  torque of the actuator [N m or N]
        tau_e  external torque [N m or N]: of everything but actuator and friction, counted as tau_m is
        N      multilayer perceptron of two outputs, of the inputs less their mean, over their standard deviation in the
               training data, and held within 5 of them, and of sines and cosines of the first, as
               `frictionzoo.models.network.GearNetwork` says; the joints share it, and each is seen alone
        n_v    standard deviation of the velocity in the training data [rad/s or m/s]
        s      torque_scale [N m or N], standard deviation of the actuator's torque in the training data
        v_0    smoothing_velocity [rad/s or m/s], over which the sign changes; it belongs to the simulation rather than
               to the drive, hence known by default

    Guarantees, whatever finite weights a fit finds and wherever the drive is:

        torque v >= 0. s, n_v and v_0 are positive, softplus(x) = log(1 + exp(x)) is not negative, and tanh(v / v_0) and
            v have the sign of v. In floating point too: products, quotients and sums of numbers of one sign keep it or
            round to 0.
        torque = 0 at v = 0.
        Beyond 5 standard deviations from the training data's mean, torque is constant but for the last factor v: dry
            friction stays bounded and viscous friction grows no faster than the velocity.

    Friction starts small, 0.05 of s and of s / n_v; from much less, softplus is slow to learn. The torque is explicit,
    and near standstill a step chatters unless (s softplus(N_1) / v_0 + (s / n_v) softplus(N_2)) timestep / inertia < 2.

    Cannot represent: sticking (the torque is 0 at v = 0, so a loaded joint creeps), friction with a memory, coupling
    between joints. It takes up any other loss of the drive that grows with what it sees, such as back-EMF.

    Source: equation of this package, in the manner of Y. D. Zhong, B. Dey, A. Chakraborty, "Dissipative SymODEN:
    Encoding Hamiltonian dynamics with dissipation and control into deep learning", 2020, whose learned dissipation is
    positive by construction; softplus: C. Dugas et al., "Incorporating second-order functional knowledge for better
    option pricing", NIPS 2000.
    """

    dimensions = {"smoothing_velocity": "velocity"}
    dissipative = True

    def __init__(self, nv: int, hidden: Sequence[int] = (64, 64), seed: int = 0, params: Params | None = None) -> None:
        super().__init__(nv, hidden, 2, seed, params)
        torch.nn.init.constant_(self.layers[-1].get_parameter("bias"), START)

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The explicit torque."""
        size = softplus(xp, self.network(xp, values, self.bounded(xp, values, state)))
        dry = size[..., 0] * xp.tanh(state.qvel / values["smoothing_velocity"])
        viscous = size[..., 1] * (state.qvel / values["input_std"][1])
        return FrictionTerms(torque=values["torque_scale"] * (dry + viscous))


def softplus(xp: Any, x: Any) -> Any:
    """A smooth max(x, 0), log(1 + exp(x)), that neither overflows nor falls below 0; torch and jax.numpy share none."""
    # (x + |x|) / 2 for the maximum, so that its gradient at 0 is 1/2 in both.
    return 0.5 * (x + xp.abs(x)) + xp.log1p(xp.exp(-xp.abs(x)))
