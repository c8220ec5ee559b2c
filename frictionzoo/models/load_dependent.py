"""Dry friction that grows with the load on the gear, as a constraint that can stop the joint."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model
from frictionzoo.models.limits import gear_load


@register_model("load_dependent")
class LoadDependent(FrictionModel):
    """Dry friction that grows with the load on the gear, as a constraint, and viscous damping.

    limit = f + k |tau_m - tau_e|

    The constraint's force makes the joint stick while it is below the limit and is the limit against the motion
    otherwise; d v adds to it.

        v      joint velocity [rad/s or m/s]
        tau_m  torque of the actuator [N m or N]
        tau_e  external torque [N m or N]: of everything but actuator and friction, counted as tau_m is
        f      frictionloss [N m or N], without load; strictly positive: at 0 MuJoCo locks the joint
        k      load_friction [1]: from 1 on no torque moves the joint
        d      damping [N m s/rad or N s/m]

    A motor that holds a weight has tau_m = -tau_e: the sum that moves the joint is 0, and the difference is twice the
    torque that the gear passes on. A weight that falls as the motor pushes it loads the gear less, or not at all.

    Cannot represent: a breakaway torque above the sliding one, a gear that loses more in one direction than in the
    other, friction that depends on position.

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, model M3.
    """

    dimensions = {"frictionloss": "torque", "damping": "damping", "load_friction": "1"}
    contains = {"mujoco_default": {"load_friction": 0.0}}
    constraint = True
    dissipative = True
    sees = ("speed", "load")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The constraint's limit in this state, and the damping."""
        load = gear_load(xp, state, values["load_friction"], values["load_friction"])
        return FrictionTerms(frictionloss=values["frictionloss"] + load, damping=values["damping"])
