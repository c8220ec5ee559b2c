"""Dry friction that falls with speed, as a constraint that can stop the joint."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.limits import stribeck_share
from frictionzoo.models.mujoco_default import MujocoDefault


@register_model("stribeck")
class Stribeck(FrictionModel):
    """Dry friction with the Stribeck effect as a constraint that can stop the joint, and viscous damping.

    Use it for joints that stick and whose breakaway torque is above the sliding torque.

    Cannot represent: friction that lags the velocity or depends on direction, load or position.

    limit = f + s exp(-|v / v_s|^alpha)

    The constraint force makes the joint stick while it is below the limit; otherwise it equals the limit and opposes
    the motion. d v adds to it.

        v      joint velocity [rad/s or m/s]
        f      frictionloss [N m or N], well above v_s; strictly positive: at 0 MuJoCo locks the joint
        s      stribeck_torque [N m or N], additional limit at rest
        v_s    stribeck_velocity [rad/s or m/s], over which s decays
        alpha  stribeck_exponent [1]: 2 is a bell, a large value a step at v_s
        d      damping [N m s/rad or N s/m]

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended friction models for the physics simulation of servo
    actuators", 2024, model M2; for the exponent B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, "A survey of
    models, analysis tools and compensation methods for the control of machines with friction", Automatica 30(7), 1994.
    """

    physical_parameters = {
        **MujocoDefault.physical_parameters,
        "stribeck_torque": Parameter("torque", 0.02, 1e-4, 2),
        "stribeck_velocity": Parameter("velocity", 0.2, 0.01, 2),
        "stribeck_exponent": Parameter("1", 2.0, 0.5, 10.0),
    }
    contains = {"mujoco_default": {"stribeck_torque": 0.0}}
    valleys = {"stribeck_velocity": (0.3, 3.0)}
    constraint = True
    dissipative = True
    sees = ("speed", "slow")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit in this state, and the damping."""
        limit = values["frictionloss"] + stribeck_share(xp, values, state.qvel) * values["stribeck_torque"]
        return FrictionTerms(frictionloss=limit, damping=values["damping"])
