"""Friction as a spring that yields."""

from typing import Any

from frictionzoo.core.state import DriveState
from frictionzoo.models import Parameter, Values, register_model
from frictionzoo.models.bristles import BristleModel


@register_model("dahl")
class Dahl(BristleModel):
    """Coulomb friction that builds up over a displacement, and viscous friction.

    Use it for drives with presliding: before a joint slips, its friction acts as a spring.

    Cannot represent: a breakaway torque above the sliding torque, friction that depends on direction, load or position.
    An oscillating load below f_c makes the joint drift.

    dz/dt = v - s |v| z / f_c,  torque = s z + d v

        v    joint velocity [rad/s or m/s]
        z    deflection of the contact, the model's memory [rad or m]
        s    stiffness [N m/rad or N/m] of the contact before it yields
        f_c  coulomb_torque [N m or N], at which it has yielded
        d    viscous_coefficient [N m s/rad or N s/m]
        v_0  rest_velocity [rad/s or m/s], below about which a joint counts as at rest when a rollout starts; known

    A rollout starts with the deflection that balances the load if the joint rests, and with the yielded deflection if
    it moves. Each step integrates the deflection exactly for constant velocity and evaluates the torque at the end of
    the step through MuJoCo's implicit damping, so it is stable at any stiffness. At constant velocity the friction is
    f_c sign(v) + d v.

    Source: P. R. Dahl, "A solid friction model", Aerospace Corporation, TOR-0158(3107-18)-1, 1968, with the exponent 1.
    """

    physical_parameters = {
        "stiffness": Parameter(
            "stiffness", 100, 1, 100_000, from_robot=True
        ),  # init: yields after 0.3 ms at typical velocity
        "coulomb_torque": Parameter("torque", 0.03, 1e-4, 2, from_robot=True),
        "viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10, from_robot=True),
        "rest_velocity": Parameter("velocity", 0.01, 0.001, 0.1, identify=False),  # a property of the measurement
    }
    valleys = {"stiffness": (0.1, 10.0)}
    sees = ("speed", "reversal")

    def limit(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the dry friction of the yielded contact [N m or N]."""
        return values["coulomb_torque"]
