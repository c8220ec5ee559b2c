"""Dry friction that changes with the position, as in meshing gears, and viscous friction."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.limits import ripple_share
from frictionzoo.models.mujoco_default import MujocoDefault


@register_model("ripple")
class Ripple(FrictionModel):
    """Dry friction as MuJoCo's constraint whose limit has two harmonics over the position, and viscous friction.

    Use it for gears whose friction changes periodically with the position.

    Cannot represent: ripple of the motor torque (cogging), which does not change sign with the direction; ripple whose
    amplitude depends on speed or load; more harmonics; a breakaway torque above the sliding torque; true sticking
    (MuJoCo's constraint creeps).

    torque = f + damping v,  |f| <= frictionloss (1 + s_1 sin(n q) + c_1 cos(n q) + s_2 sin(2 n q) + c_2 cos(2 n q))

        q             joint position [rad or m]
        v             joint velocity [rad/s or m/s]
        f             force of MuJoCo's dry-friction constraint [N m or N]
        frictionloss  limit of f, mean over the position [N m or N], strictly positive
        damping       viscous coefficient [N m s/rad or N s/m]
        n             periods [1/rad or 1/m]: for a hinge the periods per turn, of teeth or of a harmonic drive's wave;
                      for a slide 2 pi / screw pitch. A property of the gear, so it is known by default
        s_1, c_1      sine_1, cosine_1 [1], relative to frictionloss
        s_2, c_2      sine_2, cosine_2 [1], at twice the periods

    Bounds of 0.2 keep the limit above 1 - 2 sqrt(2) 0.2 = 0.43 of frictionloss; wider bounds must keep it positive.

    If n is identified, it must start close to the gear's value: the loss over n has a local minimum about every
    2 pi / (range of q). If the joint moves more than pi / (2 n) between two samples, the second harmonic looks like a
    slower ripple (aliasing).

    Source: E. Garcia, P. Gonzalez de Santos, C. Canudas de Wit, "Velocity Dependence in the Cyclic Friction Arising
    with Gears", International Journal of Robotics Research 21(9), 2002, on meshing friction over the position; this
    model omits its dependence on the speed.
    """

    physical_parameters = {
        **MujocoDefault.physical_parameters,
        "periods": Parameter("1/position", 12, 0.1, 1000, identify=False),
        "sine_1": Parameter("1", 0.0, -0.2, 0.2, 0.1),
        "cosine_1": Parameter("1", 0.0, -0.2, 0.2, 0.1),
        "sine_2": Parameter("1", 0.0, -0.2, 0.2, 0.1),
        "cosine_2": Parameter("1", 0.0, -0.2, 0.2, 0.1),
    }
    contains = {"mujoco_default": {"sine_1": 0.0, "cosine_1": 0.0, "sine_2": 0.0, "cosine_2": 0.0}}
    constraint = True
    dissipative = True
    sees = ("speed", "position")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit at this position, and the damping."""
        limit = values["frictionloss"] * (1 + ripple_share(xp, values, state.qpos))
        return FrictionTerms(frictionloss=limit, damping=values["damping"])
