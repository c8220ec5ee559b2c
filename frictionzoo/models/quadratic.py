"""Dry friction with a term that is quadratic in the load, as a constraint."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.directional import Directional
from frictionzoo.models.limits import directional_limit, stribeck_share


@register_model("quadratic")
class Quadratic(FrictionModel):
    """Dry friction that grows with the gear load and with its square, with the Stribeck effect.

    Use it for gears whose loss near standstill grows faster than the load: `directional` with a term at rest that is
    quadratic in the weaker torque, the external torque if the motor drives and the motor torque if it is driven.

    Cannot represent: friction that lags the velocity or depends on position.

    limit = f + |k_m tau_m - k_e tau_e| + (s + |l_m tau_m - l_e tau_e| + Q) exp(-|v / v_s|^alpha)
    Q = q_e tau_e^2 where |tau_e| < |tau_m|, else q_m tau_m^2, while both oppose each other; else 0

    The constraint force makes the joint stick while it is below the limit; otherwise it equals the limit and opposes
    the motion. d v adds to it.

        v         joint velocity [rad/s or m/s]
        tau_m     actuator torque [N m or N]
        tau_e     external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        f         frictionloss [N m or N], without load, well above v_s; strictly positive: at 0 MuJoCo locks the joint
        k_m, k_e  load_friction_motor, load_friction_external [1]
        s         stribeck_torque [N m or N], additional limit at rest
        l_m, l_e  stribeck_load_friction_motor, stribeck_load_friction_external [1], additional load friction at rest
        q_m, q_e  quadratic_load_friction_motor, quadratic_load_friction_external [1/(N m) or 1/N]
        v_s       stribeck_velocity [rad/s or m/s], over which s, l_m, l_e, q_m and q_e decay
        alpha     stribeck_exponent [1]: 2 is a bell, a large value a step at v_s
        d         damping [N m s/rad or N s/m]

    Unless q_m = q_e, the limit jumps at tau_m = -tau_e.

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, model M6.
    """

    physical_parameters = {
        **Directional.physical_parameters,
        "quadratic_load_friction_motor": Parameter("1/torque", 0.01, 1e-4, 1),
        "quadratic_load_friction_external": Parameter("1/torque", 0.01, 1e-4, 1),
    }
    contains = {
        "directional": {"quadratic_load_friction_motor": 0.0, "quadratic_load_friction_external": 0.0},
    }
    valleys = {"stribeck_velocity": (0.3, 3.0)}
    constraint = True
    dissipative = True
    sees = ("speed", "slow", "load")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit in this state, and the damping."""
        share = stribeck_share(xp, values, state.qvel)
        motor, external = state.motor_torque, state.external_torque
        driving = xp.abs(external) < xp.abs(motor)
        braked = values["quadratic_load_friction_external"] * xp.square(external)
        driven = values["quadratic_load_friction_motor"] * xp.square(motor)
        weaker = xp.where(driving, braked, driven)
        squared = xp.where(motor * external < 0, weaker, 0.0)
        limit = values["frictionloss"] + directional_limit(xp, values, state) + share * squared
        return FrictionTerms(frictionloss=limit, damping=values["damping"])
