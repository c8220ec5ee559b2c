"""Dry friction that depends separately on motor and external torque, as a constraint."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.limits import directional_limit
from frictionzoo.models.stribeck import Stribeck


@register_model("directional")
class Directional(FrictionModel):
    """Dry friction that grows with the gear load, separately for motor and external torque, with the Stribeck effect.

    Use it for gears that lose more in one direction of the power flow than in the other.

    Cannot represent: a loss that grows faster than the load, friction that lags the velocity or depends on position.

    limit = f + |k_m tau_m - k_e tau_e| + (s + |l_m tau_m - l_e tau_e|) exp(-|v / v_s|^alpha)

    The constraint force makes the joint stick while it is below the limit; otherwise it equals the limit and opposes
    the motion. d v adds to it. With k_m = k_e and l_m = l_e the model equals `stribeck_load_dependent`.

        v         joint velocity [rad/s or m/s]
        tau_m     actuator torque [N m or N]
        tau_e     external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        f         frictionloss [N m or N], without load, well above v_s; strictly positive: at 0 MuJoCo locks the joint
        k_m, k_e  load_friction_motor, load_friction_external [1]
        s         stribeck_torque [N m or N], additional limit at rest
        l_m, l_e  stribeck_load_friction_motor, stribeck_load_friction_external [1], additional load friction at rest
        v_s       stribeck_velocity [rad/s or m/s], over which s, l_m and l_e decay
        alpha     stribeck_exponent [1]: 2 is a bell, a large value a step at v_s
        d         damping [N m s/rad or N s/m]

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, model M5.
    """

    physical_parameters = {
        **Stribeck.physical_parameters,
        "load_friction_motor": Parameter("1", 0.02, 1e-4, 0.5),
        "load_friction_external": Parameter("1", 0.02, 1e-4, 0.5),
        "stribeck_load_friction_motor": Parameter("1", 0.02, 1e-4, 0.5),
        "stribeck_load_friction_external": Parameter("1", 0.02, 1e-4, 0.5),
    }
    contains = {
        "stribeck_load_dependent": {
            "load_friction_motor": "load_friction",
            "load_friction_external": "load_friction",
            "stribeck_load_friction_motor": "stribeck_load_friction",
            "stribeck_load_friction_external": "stribeck_load_friction",
        }
    }
    valleys = {"stribeck_velocity": (0.3, 3.0)}
    constraint = True
    dissipative = True
    sees = ("speed", "slow", "load")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit in this state, and the damping."""
        limit = values["frictionloss"] + directional_limit(xp, values, state)
        return FrictionTerms(frictionloss=limit, damping=values["damping"])
