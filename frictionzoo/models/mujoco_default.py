"""MuJoCo's joint friction."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model


@register_model("mujoco_default")
class MujocoDefault(FrictionModel):
    """MuJoCo's joint friction: dry friction as a constraint that can stop the joint, and viscous damping.

    Use it if MuJoCo itself must simulate the friction: `identified.xml` moves as the fitted model does.

    Cannot represent: a breakaway torque above the sliding torque, friction that depends on direction, load or position,
    true sticking: with MuJoCo's default `solref` the constraint creeps, viscous at very low speed.

    The constraint force f makes the joint stick while |f| < frictionloss; otherwise it equals frictionloss and opposes
    the motion. damping * v adds to it.

        v              joint velocity [rad/s or m/s]
        frictionloss   limit of the dry friction [N m or N], strictly positive: at 0 MuJoCo locks the joint
        damping        viscous coefficient [N m s/rad or N s/m]

    A shorter time constant in `bench.solreffriction` makes the constraint stiffer.

    Source: E. Todorov, T. Erez, Y. Tassa, "MuJoCo: A physics engine for model-based control", IROS 2012; MuJoCo
    documentation, "Computation", friction loss; V. Kovalev et al., Proc. MIPT 18(2), 2026, Table 1, "MuJoCo-Default".
    """

    physical_parameters = {
        "frictionloss": Parameter("torque", 0.03, 1e-4, 10, from_robot=True),
        "damping": Parameter("damping", 0.03, 1e-4, 10, from_robot=True),
    }
    constraint = True
    dissipative = True
    sees = ("speed",)
    export_target = "mjcf"

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit and the damping, independent of the state."""
        return FrictionTerms(frictionloss=values["frictionloss"], damping=values["damping"])
