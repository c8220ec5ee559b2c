"""Friction that falls from static to kinetic with speed, and viscous friction."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.bristles import stribeck_force


@register_model("coulomb_stribeck")
class CoulombStribeck(FrictionModel):
    """Coulomb friction with the Stribeck effect and a smooth sign, and viscous friction.

    Use it for friction that falls with speed where sticking does not matter; `stribeck` also sticks.

    Cannot represent: sticking (the torque is 0 at v = 0, so a loaded joint creeps), friction that lags the velocity or
    depends on direction, load or position.

    torque = (f_k + (f_s - f_k) exp(-(v / v_s)^2)) tanh(v / v_0) + d v

        v    joint velocity [rad/s or m/s]
        f_s  static_torque [N m or N], at the onset of motion
        f_k  kinetic_torque [N m or N], well above v_s
        v_s  stribeck_velocity [rad/s or m/s], over which friction falls from f_s to f_k
        v_0  smoothing_velocity [rad/s or m/s], over which the sign changes; a setting of the simulation, so it is known
             by default. v_0 << v_s, otherwise friction never reaches f_s
        d    viscous_coefficient [N m s/rad or N s/m]

    The formula printed by Kovalev et al., f_s + d v + (f_k - f_s) exp(...), swaps static and kinetic torque relative to
    its legend. This model uses the formula of the literature, with the exponent delta = 2.

    The torque is explicit: near standstill the simulation chatters unless
    (f_s / v_0 + d) timestep / inertia < 2.

    Source: B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, "A survey of models, analysis tools and compensation
    methods for the control of machines with friction", Automatica 30(7), 1994; V. Kovalev et al., Proc. MIPT 18(2),
    2026, Table 1, "Coulomb-Stribeck".
    """

    physical_parameters = {
        "static_torque": Parameter("torque", 0.05, 1e-4, 2),
        # Not equal to static_torque at the start, where stribeck_velocity has no gradient.
        "kinetic_torque": Parameter("torque", 0.03, 1e-4, 2),
        "stribeck_velocity": Parameter("velocity", 0.075, 0.02, 0.5),  # low: above smoothing_velocity
        "viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10),
        "smoothing_velocity": Parameter("velocity", 0.01, 0.002, 0.1, identify=False),  # low: the limit of stability
    }
    contains = {
        "coulomb_smooth": {
            "static_torque": "static_torque",
            "kinetic_torque": "static_torque",
            "smoothing_velocity": lambda values: 1 / (10 * values["smoothing"]),
        }
    }
    valleys = {"stribeck_velocity": (0.3, 3.0)}
    dissipative = True
    sees = ("speed", "slow")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the explicit torque."""
        dry = stribeck_force(xp, values, state.qvel) * xp.tanh(state.qvel / values["smoothing_velocity"])
        return FrictionTerms(torque=dry + values["viscous_coefficient"] * state.qvel)
