"""Friction as a neural network that knows no preferred direction."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Values, register_model
from frictionzoo.models.network import GearNetwork


@register_model("odd_network")
class OddNetwork(GearNetwork):
    """A neural network made odd: at each position, reversed motion under reversed load has the reversed friction.

    torque = s (N(q, w) - N(q, -w)) / 2,  w = (v, tau_m, tau_e)

        q      joint position [rad or m], less its mean, over its standard deviation in the training data
        v      joint velocity [rad/s or m/s]
        tau_m  torque of the actuator [N m or N]
        tau_e  external torque [N m or N]: of everything but actuator and friction, counted as tau_m is
        N      multilayer perceptron of (q, w) and of sines and cosines of q, as
               `frictionzoo.models.network.GearNetwork` says; the joints share it, and each is seen alone. The bias
               of its last layer cancels
        w      over the root mean square of each in the training data, about 0: a mean would be a preferred side. All
               that the network sees is held within 5
        s      torque_scale [N m or N], standard deviation of the actuator's torque in the training data

    Guarantees, whatever finite weights a fit finds:

        friction(q, -v, -tau_m, -tau_e) = -friction(q, v, tau_m, tau_e), to the last bit where a batch is evaluated
            again with these signs changed: both sides are half the difference of the same two numbers, in turn.
        torque = 0 where v, tau_m and tau_e are 0, at any position.
        Far outside the training data, torque is constant.

    A drive has this symmetry where nothing in it tells one direction from the other: dry, viscous and load-dependent
    friction and its ripple over the position all do. It halves what has to be learned. A drive lacks it where friction
    differs by direction (worm gears, one-sided springs or belts) and where something pulls at rest, such as cogging or
    an offset of the motor's current; neither is taken for friction then.

    Cannot represent: friction that differs by direction, sticking, friction with a memory, coupling between joints. It
    may give energy to the drive, and takes up any other odd error of the simulation.

    Source: equation of this package: the odd part of a function, as in any text on Fourier series; the network is that
    of V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "NeuralFriction", with the motor's torque for the command,
    which has no sign of its own where it is a position.
    """

    sees = ("speed", "slow", "fast", "load", "position")

    def __init__(self, nv: int, hidden: Sequence[int] = (64, 64), seed: int = 0) -> None:
        super().__init__(nv, hidden, 1, seed)

    def normalise(self, samples: DriveState) -> list[tuple[float, float]]:
        """The same of the position, and root mean squares about 0 of all else."""
        sizes = [float(np.sqrt(np.mean(np.square(signal)))) or 1.0 for signal in self.signals(samples)[1:]]
        return [super().normalise(samples)[0], *((0.0, size) for size in sizes)]

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The explicit torque."""
        sides = (self.bounded(xp, values, side) for side in (state, reverse(state)))
        there, back = (self.network(xp, values, x) for x in sides)
        # The difference before any factor: compiled, a factor may be fused with one side of it and round apart.
        return FrictionTerms(torque=0.5 * values["torque_scale"] * (there - back)[..., 0])


def reverse(state: DriveState) -> DriveState:
    """The same place in the reversed motion under the reversed load; the command stays."""
    return state._replace(qvel=-state.qvel, motor_torque=-state.motor_torque, external_torque=-state.external_torque)
