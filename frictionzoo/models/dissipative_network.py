"""Friction as a neural network that cannot drive the joint."""

from collections.abc import Sequence
from typing import Any

import torch

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Parameter, Params, Values, register_model
from frictionzoo.models.network import GearNetwork


@register_model("dissipative_network")
class DissipativeNetwork(GearNetwork):
    """Neural network for the magnitude of friction, which opposes the motion by construction.

    Use it instead of `neural_friction` if friction must never add energy to the drive.

    Cannot represent: sticking (the torque is 0 at v = 0, so a loaded joint creeps), friction with a memory, coupling
    between joints. It absorbs any other loss of the drive that grows with its inputs, such as back-EMF.

    torque = s softplus(N_1(x)) tanh(v / v_0) + (s / n_v) softplus(N_2(x)) v,  x = (q, v, tau_m, tau_e)

        q      joint position [rad or m]
        v      joint velocity [rad/s or m/s]
        tau_m  actuator torque [N m or N]
        tau_e  external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        N      multilayer perceptron with two outputs. Its inputs are x, minus its mean, divided by its standard
               deviation in the training data, clipped at 5, and sines and cosines of the position, see
               `frictionzoo.models.network.GearNetwork`; the joints share it, and each is evaluated alone
        n_v    standard deviation of the velocity in the training data [rad/s or m/s]
        s      torque_scale [N m or N], standard deviation of the actuator torque in the training data
        v_0    smoothing_velocity [rad/s or m/s], over which the sign changes; a setting of the simulation, so it is
               known by default

    Guarantees, for any finite weights and any state of the drive:

        torque v >= 0. s, n_v and v_0 are positive, softplus(x) = log(1 + exp(x)) is not negative, and tanh(v / v_0) and
            v have the sign of v. This includes floating point: products, quotients and sums of numbers of one sign keep
            it or round to 0.
        torque = 0 at v = 0.
        Beyond 5 standard deviations from the mean of the training data, torque is constant except for the last factor
            v: dry friction stays bounded and viscous friction grows no faster than the velocity.

    Friction starts small, at 0.05 of s and of s / n_v; from much smaller values softplus learns slowly. The torque is
    explicit: near standstill the simulation chatters unless
    (s softplus(N_1) / v_0 + (s / n_v) softplus(N_2)) timestep / inertia < 2.

    Source: equation of this package, after Y. D. Zhong, B. Dey, A. Chakraborty, "Dissipative SymODEN: Encoding
    Hamiltonian dynamics with dissipation and control into deep learning", 2020, whose learned dissipation is positive
    by construction; softplus: C. Dugas et al., "Incorporating second-order functional knowledge for better option
    pricing", NIPS 2000.
    """

    physical_parameters = {
        "smoothing_velocity": Parameter("velocity", 0.01, 0.002, 0.1, identify=False),  # low: the limit of stability
    }
    dissipative = True

    def __init__(self, nv: int, hidden: Sequence[int] = (64, 64), seed: int = 0, params: Params | None = None) -> None:
        super().__init__(nv, hidden, 2, seed, params)
        torch.nn.init.constant_(self.layers[-1].get_parameter("bias"), -3.0)  # softplus(-3) = 0.05

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the explicit torque."""
        size = softplus(xp, self.network(xp, values, self.bounded(xp, values, state)))
        dry = size[..., 0] * xp.tanh(state.qvel / values["smoothing_velocity"])
        viscous = size[..., 1] * (state.qvel / values["input_std"][1])
        return FrictionTerms(torque=values["torque_scale"] * (dry + viscous))


def softplus(xp: Any, x: Any) -> Any:
    """Return log(1 + exp(x)) without overflow and never below 0; torch and jax.numpy share no such function."""
    # (x + |x|) / 2 for the maximum, because its gradient at 0 is 1/2 in both.
    return 0.5 * (x + xp.abs(x)) + xp.log1p(xp.exp(-xp.abs(x)))
