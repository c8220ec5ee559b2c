"""Friction of elastic bristles that slip later under load."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model
from frictionzoo.models.bristles import bend, settled_bend, slip, stribeck_bell, stribeck_force
from frictionzoo.models.limits import gear_load
from frictionzoo.models.lugre import LuGre


@register_model("lugre_load_dependent")
class LuGreLoadDependent(FrictionModel):
    """Bristles that bend before they slip, and slip later the more the gear is loaded.

    dz/dt = v - s |v| z / g,  g = f_k + k |tau_m - tau_e| + (f_s - f_k + k_s |tau_m - tau_e|) exp(-(v / v_s)^2)
    torque = s z + c dz/dt + d v

        v      joint velocity [rad/s or m/s]
        z      mean bend of the bristles, the law's memory [rad or m]
        tau_m  torque of the actuator [N m or N]
        tau_e  external torque [N m or N]: of everything but actuator and friction, counted as tau_m is
        s      stiffness [N m/rad or N/m] of the bristles
        c      micro_damping [N m s/rad or N s/m], of their bending
        f_s    static_torque [N m or N], at the onset of motion without load
        f_k    kinetic_torque [N m or N], well above v_s without load
        k      load_friction [1]: from 1 on no torque moves the joint
        k_s    stribeck_load_friction [1], by which k is larger at rest
        v_s    stribeck_velocity [rad/s or m/s], over which f_s falls to f_k, and k_s is lost
        d      viscous_coefficient [N m s/rad or N s/m]
        v_0    rest_velocity [rad/s or m/s], up to about which a joint may stand still where a rollout begins; known

    `lugre` whose limit grows with the load, as that of `stribeck_load_dependent` does; the stiffness does not.
    Beginning and step of a rollout are those of `lugre`. At constant velocity and load the law is g sign(v) + d v; a
    load that is taken off a joint at rest leaves the bend as it is, until the joint moves.

    Cannot represent: a gear that loses more in one direction than in the other, friction that depends on position. A
    load that swings below g lets the joint drift, and a loop of presliding does not close.

    Source: C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, "A new model for control of systems with
    friction", IEEE Transactions on Automatic Control 40(3), 1995; the load: M. Duclusaud, G. Passault, V. Padois,
    O. Ly, "Extended friction models for the physics simulation of servo actuators", 2024, model M4. Their composition
    is this package's.
    """

    dimensions = {**LuGre.dimensions, "load_friction": "1", "stribeck_load_friction": "1"}
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
    dissipative = True
    sees = ("speed", "slow", "load", "reversal")
    memory = 1

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The slipping bristles."""
        return slip(xp, values, state, self._limit(xp, values, state))

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """The bend of a joint at rest or in steady motion."""
        return settled_bend(xp, values, state, self._limit(xp, values, state))

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """The bristles' torque at the end of the step."""
        limit = self._limit(xp, values, state)
        return bend(xp, values, state, memory, timestep, limit, values["micro_damping"])

    def _limit(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Dry friction of the slipping bristles at this velocity and under this load [N m or N]."""
        load = gear_load(xp, state, values["load_friction"], values["load_friction"])
        at_rest = gear_load(xp, state, values["stribeck_load_friction"], values["stribeck_load_friction"])
        share = stribeck_bell(xp, values, state.qvel)
        return stribeck_force(xp, values, state.qvel) + load + share * at_rest
