"""Friction of elastic bristles."""

from typing import Any

from frictionzoo.core.state import DriveState
from frictionzoo.models import Parameter, Values, register_model
from frictionzoo.models.bristles import BristleModel, stribeck_force


@register_model("lugre")
class LuGre(BristleModel):
    """Elastic bristles that deflect before they slip: presliding, breakaway, Stribeck effect and friction lag.

    Use it for drives with presliding and a breakaway torque above the sliding torque; without the latter, `dahl`
    suffices.

    Cannot represent: friction that depends on direction, load or position. An oscillating load below f_s makes the
    joint drift, and a loop of presliding does not close.

    dz/dt = v - s |v| z / g(v),  g(v) = f_k + (f_s - f_k) exp(-(v / v_s)^2)
    torque = s z + c dz/dt + d v

        v    joint velocity [rad/s or m/s]
        z    mean deflection of the bristles, the model's memory [rad or m]
        s    stiffness [N m/rad or N/m] of the bristles
        c    micro_damping [N m s/rad or N s/m] of their deflection
        f_s  static_torque [N m or N], at the onset of motion
        f_k  kinetic_torque [N m or N], well above v_s
        v_s  stribeck_velocity [rad/s or m/s], over which friction falls from f_s to f_k
        d    viscous_coefficient [N m s/rad or N s/m]
        v_0  rest_velocity [rad/s or m/s], below about which a joint counts as at rest when a rollout starts; known

    A rollout starts with the deflection that balances the load if the joint rests, and with the deflection of slipping
    bristles if it moves. Each step integrates the deflection exactly for constant velocity and evaluates the torque at
    the end of the step through MuJoCo's implicit damping, so it is stable at any stiffness. At constant velocity the
    friction is g(v) sign(v) + d v.

    Source: C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, "A new model for control of systems with
    friction", IEEE Transactions on Automatic Control 40(3), 1995.
    """

    physical_parameters = {
        "stiffness": Parameter("stiffness", 100, 1, 100_000, from_robot=True),
        "micro_damping": Parameter("damping", 0.03, 1e-4, 10, from_robot=True),
        "static_torque": Parameter("torque", 0.05, 1e-4, 2, from_robot=True),
        # Not equal to static_torque at the start, where stribeck_velocity has no gradient.
        "kinetic_torque": Parameter("torque", 0.03, 1e-4, 2, from_robot=True),
        "stribeck_velocity": Parameter("velocity", 0.075, 0.005, 0.5, from_robot=True),
        "viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10, from_robot=True),
        "rest_velocity": Parameter("velocity", 0.01, 0.001, 0.1, identify=False),  # a property of the measurement
    }
    contains = {
        "dahl": {"micro_damping": 0.0, "static_torque": "coulomb_torque", "kinetic_torque": "coulomb_torque"},
    }
    valleys = {"stribeck_velocity": (0.3, 3.0), "stiffness": (0.1, 10.0)}
    sees = ("speed", "slow", "reversal")

    def limit(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the dry friction of slipping bristles at this velocity [N m or N]."""
        return stribeck_force(xp, values, state.qvel)
