"""Coulomb and viscous friction that differ by direction."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model


@register_model("asymmetric")
class Asymmetric(FrictionModel):
    """Coulomb and viscous friction that differ by direction; the dry part is MuJoCo's constraint, which can stick.

    Use it for drives that need more torque in one direction than in the other.

    Cannot represent: a breakaway torque above the sliding torque, friction that depends on load or position, true
    sticking (a joint at rest creeps).

    torque = f + (F_+ - F_-) / 2 + d v,  |f| <= (F_+ + F_-) / 2,  d = d_+ for v > 0 and d_- otherwise

        v    joint velocity [rad/s or m/s]
        f    force of MuJoCo's dry-friction constraint [N m or N]: makes the joint stick within its limit; otherwise
             equals the limit and opposes the motion
        F_+  frictionloss_forward [N m or N], strictly positive
        F_-  frictionloss_backward [N m or N], strictly positive
        d_+  damping_forward [N m s/rad or N s/m]
        d_-  damping_backward [N m s/rad or N s/m]

    Limit and constant together give dry friction F_+ sliding forward and -F_- sliding backward, and hold every load in
    between, without a smooth sign.

    If the actuator has an identified constant (EMPS: bench.actuator.params.force_offset), the data cannot separate it
    from (F_+ - F_-) / 2: fix one of them as known.

    MuJoCo's constraint is soft and yields to (F_+ - F_-) / 2 as to any load. Without load, a joint at rest creeps at
    |F_+ - F_-| / (F_+ + F_-) of its creep speed under a load at the limit.

    Source: A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of EMPS", Workshop on Nonlinear System
    Identification Benchmarks, 2019, whose reference model has symmetric friction and the constant; MuJoCo
    documentation, "Computation", friction loss.
    """

    physical_parameters = {
        "frictionloss_forward": Parameter("torque", 0.03, 1e-4, 10),
        "frictionloss_backward": Parameter("torque", 0.03, 1e-4, 10),
        "damping_forward": Parameter("damping", 0.03, 1e-4, 10),
        "damping_backward": Parameter("damping", 0.03, 1e-4, 10),
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
        """Return the constant torque, the constraint's limit, and the damping for the direction of motion."""
        forward, backward = values["frictionloss_forward"], values["frictionloss_backward"]
        damping = xp.where(state.qvel > 0, values["damping_forward"], values["damping_backward"])
        return FrictionTerms(torque=(forward - backward) / 2, frictionloss=(forward + backward) / 2, damping=damping)
