"""Coulomb friction with a smooth sign, and viscous friction."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model


@register_model("coulomb_smooth")
class CoulombSmooth(FrictionModel):
    """Coulomb friction with a sign that is smooth around standstill, and viscous friction.

    Use it where sticking does not matter; `mujoco_default` also sticks.

    Cannot represent: sticking (the torque is 0 at v = 0, so a loaded joint creeps), a breakaway torque above the
    sliding torque, friction that depends on direction, load or position.

    torque = tanh(10 g v) |f_s| + d v

        v    joint velocity [rad/s or m/s]
        f_s  static_torque [N m or N]
        g    smoothing [s/rad or s/m]: the sign saturates at about |v| = 1 / (5 g)
        d    viscous_coefficient [N m s/rad or N s/m]

    The torque is explicit: near standstill the simulation chatters unless
    (10 g f_s + d) timestep / inertia < 2.

    Source: V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "Coulomb-Smooth".
    """

    physical_parameters = {
        "static_torque": Parameter("torque", 0.03, 1e-4, 2),
        "smoothing": Parameter("1/velocity", 3, 0.1, 10),  # init: the sign saturates at 0.07 of the typical velocity
        "viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10),
    }
    dissipative = True
    sees = ("speed",)

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the explicit torque."""
        direction = xp.tanh(10 * values["smoothing"] * state.qvel)
        dry = direction * xp.abs(values["static_torque"])
        return FrictionTerms(torque=dry + values["viscous_coefficient"] * state.qvel)
