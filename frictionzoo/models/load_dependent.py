"""Dry friction that grows with the gear load, as a constraint that can stop the joint."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.limits import gear_load
from frictionzoo.models.mujoco_default import MujocoDefault


@register_model("load_dependent")
class LoadDependent(FrictionModel):
    """Dry friction that grows with the gear load, as a constraint, and viscous damping.

    Use it for gears that lose a fraction of the torque that they transmit, equal in both directions of the power flow.

    Cannot represent: a breakaway torque above the sliding torque, a gear that loses more in one direction than in the
    other, friction that depends on position.

    limit = f + k |tau_m - tau_e|

    The constraint force makes the joint stick while it is below the limit; otherwise it equals the limit and opposes
    the motion. d v adds to it.

        v      joint velocity [rad/s or m/s]
        tau_m  actuator torque [N m or N]
        tau_e  external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        f      frictionloss [N m or N], without load; strictly positive: at 0 MuJoCo locks the joint
        k      load_friction [1]: at 1 or above, no torque moves the joint
        d      damping [N m s/rad or N s/m]

    A motor that holds a weight has tau_m = -tau_e: the sum, which moves the joint, is 0, and the difference is twice
    the torque that the gear transmits. A weight that falls in the direction of the motor torque loads the gear less, or
    not at all.

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, model M3.
    """

    physical_parameters = {
        **MujocoDefault.physical_parameters,
        "load_friction": Parameter("1", 0.02, 1e-4, 0.5),
    }
    contains = {"mujoco_default": {"load_friction": 0.0}}
    constraint = True
    dissipative = True
    sees = ("speed", "load")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit in this state, and the damping."""
        load = gear_load(xp, state, values["load_friction"], values["load_friction"])
        return FrictionTerms(frictionloss=values["frictionloss"] + load, damping=values["damping"])
