"""Friction as a spring that yields later under load."""

from typing import Any

from frictionzoo.core.state import DriveState
from frictionzoo.models import Parameter, Values, register_model
from frictionzoo.models.bristles import BristleModel
from frictionzoo.models.dahl import Dahl
from frictionzoo.models.limits import gear_load


@register_model("dahl_load_dependent")
class DahlLoadDependent(BristleModel):
    """Coulomb friction that grows with the gear load and builds up over a displacement, and viscous friction.

    Use it for drives with presliding whose gear loses torque under load: `dahl` with the load term of `load_dependent`.

    Cannot represent: a breakaway torque above the sliding torque, a gear that loses more in one direction than in the
    other, friction that depends on position. An oscillating load below g makes the joint drift.

    dz/dt = v - s |v| z / g,  g = f_c + k |tau_m - tau_e|
    torque = s z + d v

        v      joint velocity [rad/s or m/s]
        z      deflection of the contact, the model's memory [rad or m]
        tau_m  actuator torque [N m or N]
        tau_e  external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        s      stiffness [N m/rad or N/m] of the contact before it yields
        f_c    coulomb_torque [N m or N], at which it has yielded without load
        k      load_friction [1]: at 1 or above, no torque moves the joint
        d      viscous_coefficient [N m s/rad or N s/m]
        v_0    rest_velocity [rad/s or m/s], below about which a joint counts as at rest when a rollout starts; known

    The stiffness does not depend on the load: a loaded contact yields later, after g / s. Rollouts start, and steps are
    integrated, as for `dahl`. At constant velocity and load the friction is g sign(v) + d v. If the load on a
    joint at rest is removed, the deflection stays until the joint moves.

    Source: P. R. Dahl, "A solid friction model", Aerospace Corporation, TOR-0158(3107-18)-1, 1968, with the exponent 1;
    the load: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, model M3. The combination is this package's.
    """

    physical_parameters = {
        **Dahl.physical_parameters,
        "load_friction": Parameter("1", 0.02, 1e-4, 0.5),
    }
    contains = {"dahl": {"load_friction": 0.0}}
    valleys = {"stiffness": (0.1, 10.0)}
    sees = ("speed", "load", "reversal")

    def limit(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the dry friction of the yielded contact under this load [N m or N]."""
        return values["coulomb_torque"] + gear_load(xp, state, values["load_friction"], values["load_friction"])
