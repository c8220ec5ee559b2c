"""Friction of elastic bristles that slip later under load."""

from typing import Any

from frictionzoo.core.state import DriveState
from frictionzoo.models import Parameter, Values, register_model
from frictionzoo.models.bristles import BristleModel, stribeck_bell, stribeck_force
from frictionzoo.models.limits import gear_load
from frictionzoo.models.lugre import LuGre


@register_model("lugre_load_dependent")
class LuGreLoadDependent(BristleModel):
    """Elastic bristles that deflect before they slip; they slip later under gear load.

    Use it for drives with presliding and breakaway whose gear loses torque under load: `lugre` with the load terms of
    `stribeck_load_dependent`.

    Cannot represent: a gear that loses more in one direction than in the other, friction that depends on position. An
    oscillating load below g makes the joint drift, and a loop of presliding does not close.

    dz/dt = v - s |v| z / g,  g = f_k + k |tau_m - tau_e| + (f_s - f_k + k_s |tau_m - tau_e|) exp(-(v / v_s)^2)
    torque = s z + c dz/dt + d v

        v      joint velocity [rad/s or m/s]
        z      mean deflection of the bristles, the model's memory [rad or m]
        tau_m  actuator torque [N m or N]
        tau_e  external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        s      stiffness [N m/rad or N/m] of the bristles
        c      micro_damping [N m s/rad or N s/m] of their deflection
        f_s    static_torque [N m or N], at the onset of motion without load
        f_k    kinetic_torque [N m or N], well above v_s without load
        k      load_friction [1]: at 1 or above, no torque moves the joint
        k_s    stribeck_load_friction [1], increase of k at rest
        v_s    stribeck_velocity [rad/s or m/s], over which f_s falls to f_k and k_s decays
        d      viscous_coefficient [N m s/rad or N s/m]
        v_0    rest_velocity [rad/s or m/s], below about which a joint counts as at rest when a rollout starts; known

    The stiffness does not depend on the load. Rollouts start, and steps are integrated, as for `lugre`. At constant
    velocity and load the friction is g sign(v) + d v. If the load on a joint at rest is removed, the deflection stays
    until the joint moves.

    Source: C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, "A new model for control of systems with
    friction", IEEE Transactions on Automatic Control 40(3), 1995; the load: M. Duclusaud, G. Passault, V. Padois,
    O. Ly, "Extended friction models for the physics simulation of servo actuators", 2024, model M4. The combination is
    this package's.
    """

    physical_parameters = {
        **LuGre.physical_parameters,
        "load_friction": Parameter("1", 0.02, 1e-4, 0.5),
        "stribeck_load_friction": Parameter("1", 0.02, 1e-4, 0.5),
    }
    contains = {
        "lugre": {"load_friction": 0.0, "stribeck_load_friction": 0.0},
        "dahl_load_dependent": {
            "micro_damping": 0.0,
            "static_torque": "coulomb_torque",
            "kinetic_torque": "coulomb_torque",
            "stribeck_load_friction": 0.0,
        },
    }
    valleys = {"stribeck_velocity": (0.3, 3.0), "stiffness": (0.1, 10.0)}
    sees = ("speed", "slow", "load", "reversal")

    def limit(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the dry friction of slipping bristles at this velocity and load [N m or N]."""
        load = gear_load(xp, state, values["load_friction"], values["load_friction"])
        at_rest = gear_load(xp, state, values["stribeck_load_friction"], values["stribeck_load_friction"])
        share = stribeck_bell(xp, values, state.qvel)
        return stribeck_force(xp, values, state.qvel) + load + share * at_rest
