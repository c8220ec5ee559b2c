"""Dry friction that grows with the gear load and falls with speed, as a constraint."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.limits import gear_load, stribeck_share
from frictionzoo.models.stribeck import Stribeck


@register_model("stribeck_load_dependent")
class StribeckLoadDependent(FrictionModel):
    """Dry friction that grows with the gear load, with the Stribeck effect, and viscous damping.

    Use it for gears that lose torque under load and have a breakaway torque above the sliding torque.

    Cannot represent: a gear that loses more in one direction than in the other, friction that lags the velocity or
    depends on position.

    limit = f + k |tau_m - tau_e| + (s + k_s |tau_m - tau_e|) exp(-|v / v_s|^alpha)

    The constraint force makes the joint stick while it is below the limit; otherwise it equals the limit and opposes
    the motion. d v adds to it. For the gear load see `load_dependent`.

        v      joint velocity [rad/s or m/s]
        tau_m  actuator torque [N m or N]
        tau_e  external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        f      frictionloss [N m or N], without load, well above v_s; strictly positive: at 0 MuJoCo locks the joint
        k      load_friction [1]: at 1 or above, no torque moves the joint
        s      stribeck_torque [N m or N], additional limit at rest
        k_s    stribeck_load_friction [1], increase of k at rest
        v_s    stribeck_velocity [rad/s or m/s], over which s and k_s decay
        alpha  stribeck_exponent [1]: 2 is a bell, a large value a step at v_s
        d      damping [N m s/rad or N s/m]

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, model M4.
    """

    physical_parameters = {
        **Stribeck.physical_parameters,
        "load_friction": Parameter("1", 0.02, 1e-4, 0.5),
        "stribeck_load_friction": Parameter("1", 0.02, 1e-4, 0.5),
    }
    contains = {
        "stribeck": {"load_friction": 0.0, "stribeck_load_friction": 0.0},
        "load_dependent": {"stribeck_torque": 0.0, "stribeck_load_friction": 0.0},
    }
    valleys = {"stribeck_velocity": (0.3, 3.0)}
    constraint = True
    dissipative = True
    sees = ("speed", "slow", "load")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit in this state, and the damping."""
        share = stribeck_share(xp, values, state.qvel)
        load = gear_load(xp, state, values["load_friction"], values["load_friction"])
        at_rest = gear_load(xp, state, values["stribeck_load_friction"], values["stribeck_load_friction"])
        limit = values["frictionloss"] + load + share * (values["stribeck_torque"] + at_rest)
        return FrictionTerms(frictionloss=limit, damping=values["damping"])
