"""Friction with a Stribeck effect, differentiable to every order, also where the direction changes."""

from collections.abc import Mapping
from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, register_model


@register_model("makkar")
class Makkar(FrictionModel):
    """Coulomb friction, the Stribeck effect and viscous friction, continuously differentiable.

    torque = g1 (tanh(g2 v) - tanh(g3 v)) + g4 tanh(g5 v) + g6 v

        v   joint velocity [rad/s or m/s]
        g1  stribeck_torque [N m or N], excess of static over Coulomb friction for g2 >> g3
        g2  stribeck_rise [s/rad or s/m], steepness with which the excess sets in; fixed by default, like g5, because
            both smooth the sign, which is a property of the simulation rather than of the drive
        g3  stribeck_decay [s/rad or s/m], steepness with which the excess decays; it vanishes from about v = 2 / g3
        g4  coulomb_torque [N m or N]
        g5  coulomb_rise [s/rad or s/m], steepness of the change of sign
        g6  viscous_coefficient [N m s/rad or N s/m]

    It opposes the motion if g2 >= g3, which the bounds ensure. The torque is explicit: near standstill
    the simulation chatters unless (g1 (g2 - g3) + g4 g5 + g6) timestep / inertia < 2.

    Cannot represent: sticking (the torque is 0 at v = 0, so a loaded joint creeps), friction that lags the velocity or
    depends on direction, load or position.

    Source: C. Makkar, W. E. Dixon, W. G. Sawyer, G. Hu, "A new continuously differentiable friction model for control
    systems design", Proc. IEEE/ASME Int. Conf. on Advanced Intelligent Mechatronics, 2005, whose gamma_1 to gamma_6
    are g1 to g6.
    """

    # Multiples of the bench's typical torque, velocity and damping, so they suit both a servo and a carriage.
    physical_parameters = {
        "stribeck_torque": Parameter("torque", init=0.02, low=1e-4, high=2),
        "stribeck_rise": Parameter("1/velocity", 100, 50, 500, identify=False),  # low: above stribeck_decay
        "stribeck_decay": Parameter("1/velocity", 10, 1, 40),
        "coulomb_torque": Parameter("torque", 0.03, 1e-4, 2),
        "coulomb_rise": Parameter("1/velocity", 100, 10, 500, identify=False),
        "viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10),
    }
    dissipative = True

    def terms(self, xp: Any, values: Mapping[str, Any], state: DriveState) -> FrictionTerms:
        """Return the explicit torque."""
        velocity = state.qvel
        excess = xp.tanh(values["stribeck_rise"] * velocity) - xp.tanh(values["stribeck_decay"] * velocity)
        coulomb = values["coulomb_torque"] * xp.tanh(values["coulomb_rise"] * velocity)
        viscous = values["viscous_coefficient"] * velocity
        return FrictionTerms(torque=values["stribeck_torque"] * excess + coulomb + viscous)
