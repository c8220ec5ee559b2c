"""Coulomb and viscous friction of another size in each direction."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model


@register_model("asymmetric")
class Asymmetric(FrictionModel):
    """Coulomb and viscous friction that differ by direction, the dry part as MuJoCo's constraint, which can stick.

    torque = f + (F_+ - F_-) / 2 + d v,  |f| <= (F_+ + F_-) / 2,  d = d_+ for v > 0 and d_- otherwise

        v    joint velocity [rad/s or m/s]
        f    force of MuJoCo's dry-friction constraint [N m or N]: whatever makes the joint stick within its limit, and
             the limit against the motion otherwise
        F_+  frictionloss_forward [N m or N], strictly positive
        F_-  frictionloss_backward [N m or N], strictly positive
        d_+  damping_forward [N m s/rad or N s/m]
        d_-  damping_backward [N m s/rad or N s/m]

    The dry part is F_+ sliding forward and -F_- sliding backward, and holds every load between the two: limit and
    constant together are exactly that, without a smooth sign.

    On a bench whose actuator has an identified constant (EMPS: bench.actuator.params.force_offset) no recording tells
    that constant from (F_+ - F_-) / 2: set one of them to known.

    Cannot represent: a breakaway torque above the sliding one, friction that depends on load or position, and true
    sticking: MuJoCo's constraint is soft, and yields to (F_+ - F_-) / 2 as to any load. A joint at rest without load
    creeps at |F_+ - F_-| / (F_+ + F_-) of the speed at which it creeps under a load at its limit.

    Source: A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of EMPS", Workshop on Nonlinear System
    Identification Benchmarks, 2019, whose reference model has symmetric friction and the constant; MuJoCo
    documentation, "Computation", friction loss.
    """

    dimensions = {
        "frictionloss_forward": "torque",
        "frictionloss_backward": "torque",
        "damping_forward": "damping",
        "damping_backward": "damping",
    }
    contains = {
        "mujoco_default": {
            "frictionloss_forward": "frictionloss",
            "frictionloss_backward": "frictionloss",
            "damping_forward": "damping",
            "damping_backward": "damping",
        }
    }
    constraint = True
    dissipative = True
    sees = ("speed", "direction")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The constant, the constraint's limit, and the damping of the direction."""
        forward, backward = values["frictionloss_forward"], values["frictionloss_backward"]
        damping = xp.where(state.qvel > 0, values["damping_forward"], values["damping_backward"])
        return FrictionTerms(torque=(forward - backward) / 2, frictionloss=(forward + backward) / 2, damping=damping)
