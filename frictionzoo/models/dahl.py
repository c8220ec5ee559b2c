"""Friction as a spring that yields."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model
from frictionzoo.models.bristles import remaining, settled_force


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
        dry = values["coulomb_torque"] * xp.tanh(state.qvel / values["rest_velocity"])
        return FrictionTerms(torque=dry, damping=values["viscous_coefficient"])

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """The bend of a joint at rest or in steady motion."""
        force = settled_force(xp, state, values["coulomb_torque"], values["rest_velocity"])
        return (force / values["stiffness"])[..., None]

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """The spring's torque at the end of the step."""
        stiffness = values["stiffness"]
        rate = stiffness * xp.abs(state.qvel) / values["coulomb_torque"]
        decay, reach = remaining(xp, rate, timestep)
        bend = decay * memory[..., 0] + reach * state.qvel
        damping = stiffness * reach + values["viscous_coefficient"]
        return FrictionTerms(torque=stiffness * decay * bend, damping=damping), bend[..., None]
