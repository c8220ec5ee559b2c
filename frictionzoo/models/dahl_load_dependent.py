"""Friction as a spring that yields later under load."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model
from frictionzoo.models.bristles import bend, settled_bend, slip
from frictionzoo.models.dahl import Dahl
from frictionzoo.models.limits import gear_load


@register_model("dahl_load_dependent")
class DahlLoadDependent(FrictionModel):
    """Coulomb friction that grows with the load on the gear and builds up over a displacement, and viscous friction.

    dz/dt = v - s |v| z / g,  g = f_c + k |tau_m - tau_e|
    torque = s z + d v

        v      joint velocity [rad/s or m/s]
        z      bend of the contact, the law's memory [rad or m]
        tau_m  torque of the actuator [N m or N]
        tau_e  external torque [N m or N]: of everything but actuator and friction, counted as tau_m is
        s      stiffness [N m/rad or N/m] of the contact before it yields
        f_c    coulomb_torque [N m or N], at which it has yielded without load
        k      load_friction [1]: from 1 on no torque moves the joint
        d      viscous_coefficient [N m s/rad or N s/m]
        v_0    rest_velocity [rad/s or m/s], up to about which a joint may stand still where a rollout begins; known

    `dahl` whose Coulomb friction grows with the load, which is that of `load_dependent`. The stiffness does not: a
    loaded contact yields later, after g / s. Beginning and step of a rollout are those of `dahl`. At constant velocity
    and load the law is g sign(v) + d v; a load that is taken off a joint at rest leaves the bend as it is, until the
    joint moves.

    Cannot represent: a breakaway torque above the sliding one, a gear that loses more in one direction than in the
    other, friction that depends on position. A load that swings below g lets the joint drift.

    Source: P. R. Dahl, "A solid friction model", Aerospace Corporation, TOR-0158(3107-18)-1, 1968, with the exponent 1;
    the load: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, model M3. Their composition is this package's.
    """

    dimensions = {**Dahl.dimensions, "load_friction": "1"}
    contains = {"dahl": {"load_friction": 0.0}}
    valleys = {"stiffness": (0.1, 10.0)}
    dissipative = True
    sees = ("speed", "load", "reversal")
    memory = 1

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The yielded contact."""
        return slip(xp, values, state, self._limit(xp, values, state))

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """The bend of a joint at rest or in steady motion."""
        return settled_bend(xp, values, state, self._limit(xp, values, state))

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """The spring's torque at the end of the step."""
        return bend(xp, values, state, memory, timestep, self._limit(xp, values, state), 0.0)

    def _limit(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Dry friction of the yielded contact under this load [N m or N]."""
        return values["coulomb_torque"] + gear_load(xp, state, values["load_friction"], values["load_friction"])
