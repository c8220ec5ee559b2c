"""Friction as a spring that yields."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model
from frictionzoo.models.bristles import bend, settled_bend, slip


@register_model("dahl")
class Dahl(FrictionModel):
    """Coulomb friction that builds up over a displacement, and viscous friction.

    dz/dt = v - s |v| z / f_c,  torque = s z + d v

        v    joint velocity [rad/s or m/s]
        z    bend of the contact, the law's memory [rad or m]
        s    stiffness [N m/rad or N/m] of the contact before it yields
        f_c  coulomb_torque [N m or N], at which it has yielded
        d    viscous_coefficient [N m s/rad or N s/m]
        v_0  rest_velocity [rad/s or m/s], up to about which a joint may stand still where a rollout begins; known

    A rollout begins with the bend that holds the drive's load if the joint rests, and with the yielded one if it moves.
    The bend is advanced exactly for a velocity that is constant in a step, and the torque taken at the step's end, by
    way of MuJoCo's implicit damping: no stiffness makes the step unstable. At constant velocity the law is
    f_c sign(v) + d v.

    Cannot represent: a breakaway torque above the sliding one, friction that depends on direction, load or position. A
    load that swings below f_c lets the joint drift.

    Source: P. R. Dahl, "A solid friction model", Aerospace Corporation, TOR-0158(3107-18)-1, 1968, with the exponent 1.
    """

    dimensions = {
        "stiffness": "stiffness",
        "coulomb_torque": "torque",
        "viscous_coefficient": "damping",
        "rest_velocity": "velocity",
    }
    valleys = {"stiffness": (0.1, 10.0)}
    dissipative = True
    sees = ("speed", "reversal")
    memory = 1

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The yielded contact."""
        return slip(xp, values, state, values["coulomb_torque"])

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """The bend of a joint at rest or in steady motion."""
        return settled_bend(xp, values, state, values["coulomb_torque"])

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """The spring's torque at the end of the step."""
        return bend(xp, values, state, memory, timestep, values["coulomb_torque"], 0.0)
