"""Friction as a neural network without a preferred direction."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Values, register_model
from frictionzoo.models.network import GearNetwork, reverse


@register_model("odd_network")
class OddNetwork(GearNetwork):
    """Neural network with odd symmetry: at each position, reversed motion and load give reversed friction.

    Use it for drives without a preferred direction: dry, viscous and load-dependent friction and its ripple over the
    position all have this symmetry. It halves the function that the network must learn.

    Cannot represent: friction that differs by direction (worm gears, one-sided springs or belts), sticking, friction
    with a memory, coupling between joints. Torques at rest, such as cogging or a current offset, are not attributed to
    friction. It may add energy to the drive, and absorbs any other odd error of the simulation.

    torque = s (N(q, w) - N(q, -w)) / 2,  w = (v, tau_m, tau_e)

        q      joint position [rad or m], minus its mean, divided by its standard deviation in the training data
        v      joint velocity [rad/s or m/s]
        tau_m  actuator torque [N m or N]
        tau_e  external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        N      multilayer perceptron of (q, w) and of sines and cosines of q, see
               `frictionzoo.models.network.GearNetwork`; the joints share it, and each is evaluated alone. The bias of
               its last layer cancels
        w      each divided by its root mean square in the training data, without subtracting a mean, which would prefer
               a direction. All inputs are clipped at 5
        s      torque_scale [N m or N], standard deviation of the actuator torque in the training data

    Guarantees, for any finite weights:

        friction(q, -v, -tau_m, -tau_e) = -friction(q, v, tau_m, tau_e), to the last bit if a batch is evaluated again
            with these signs changed: both sides are half the difference of the same two numbers.
        torque = 0 if v, tau_m and tau_e are 0, at any position.
        Far outside the training data, torque is constant.

    Source: equation of this package: the odd part of a function, as in any text on Fourier series; the network is from
    V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "NeuralFriction", with the motor torque instead of the command,
    because a position command has no sign that reverses with the motion.
    """

    sees: ClassVar[tuple[str, ...]] = ("speed", "slow", "fast", "load", "position")

    def __init__(self, nv: int, hidden: Sequence[int] = (64, 64), seed: int = 0) -> None:
        super().__init__(nv, hidden, 1, seed)

    def normalise(self, samples: DriveState) -> list[tuple[float, float]]:
        """Return mean and standard deviation of the position, and 0 and root mean square of the other signals."""
        sizes = [float(np.sqrt(np.mean(np.square(signal)))) or 1.0 for signal in self.signals(samples)[1:]]
        return [super().normalise(samples)[0], *((0.0, size) for size in sizes)]

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the explicit torque."""
        sides = (self.bounded(xp, values, side) for side in (state, reverse(state)))
        there, back = (self.network(xp, values, x) for x in sides)
        # Subtract before any factor: a compiler may fuse a factor with one side only, which rounds differently.
        return FrictionTerms(torque=0.5 * values["torque_scale"] * (there - back)[..., 0])
