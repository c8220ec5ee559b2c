"""Friction of elastic bristles."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model
from frictionzoo.models.bristles import bend, settled_bend, slip, stribeck_force


@register_model("lugre")
class LuGre(FrictionModel):
    """Bristles that bend before they slip: presliding, breakaway, Stribeck effect and lag in one law.

    dz/dt = v - s |v| z / g(v),  g(v) = f_k + (f_s - f_k) exp(-(v / v_s)^2)
    torque = s z + c dz/dt + d v

        v    joint velocity [rad/s or m/s]
        z    mean bend of the bristles, the law's memory [rad or m]
        s    stiffness [N m/rad or N/m] of the bristles
        c    micro_damping [N m s/rad or N s/m], of their bending
        f_s  static_torque [N m or N], at the onset of motion
        f_k  kinetic_torque [N m or N], well above v_s
        v_s  stribeck_velocity [rad/s or m/s], over which the one falls to the other
        d    viscous_coefficient [N m s/rad or N s/m]
        v_0  rest_velocity [rad/s or m/s], up to about which a joint may stand still where a rollout begins; known

    A rollout begins with the bend that holds the drive's load if the joint rests, and with the slipping one if it
    moves. The bend is advanced exactly for a velocity that is constant in a step, and the torque taken at the step's
    end, by way of MuJoCo's implicit damping: no stiffness makes the step unstable. At constant velocity the law is
    g(v) sign(v) + d v.

    Cannot represent: friction that depends on direction, load or position. A load that swings below f_s lets the joint
    drift, and a loop of presliding does not close.

    Source: C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, "A new model for control of systems with
    friction", IEEE Transactions on Automatic Control 40(3), 1995.
    """

    dimensions = {
        "stiffness": "stiffness",
        "micro_damping": "damping",
        "static_torque": "torque",
        "kinetic_torque": "torque",
        "stribeck_velocity": "velocity",
        "viscous_coefficient": "damping",
        "rest_velocity": "velocity",
    }
    contains = {
        "dahl": {"micro_damping": 0.0, "static_torque": "coulomb_torque", "kinetic_torque": "coulomb_torque"},
    }
    valleys = {"stribeck_velocity": (0.3, 3.0), "stiffness": (0.1, 10.0)}
    dissipative = True
    sees = ("speed", "slow", "reversal")
    memory = 1

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The slipping bristles."""
        return slip(xp, values, state, stribeck_force(xp, values, state.qvel))

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """The bend of a joint at rest or in steady motion."""
        return settled_bend(xp, values, state, stribeck_force(xp, values, state.qvel))

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """The bristles' torque at the end of the step."""
        limit = stribeck_force(xp, values, state.qvel)
        return bend(xp, values, state, memory, timestep, limit, values["micro_damping"])
