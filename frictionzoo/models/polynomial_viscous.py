"""Dry friction, and viscous friction as a polynomial of the speed."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.mujoco_default import MujocoDefault


@register_model("polynomial_viscous")
class PolynomialViscous(FrictionModel):
    """Dry friction as MuJoCo's constraint, and viscous friction with a linear, a quadratic and a cubic term.

    Use it if viscous friction grows faster than the speed.

    Cannot represent: viscous friction that grows less than in proportion to the speed (lubricants that thin under
    shear), because no coefficient is negative; a breakaway torque above the sliding torque; friction that depends on
    direction, load or position; true sticking (MuJoCo's constraint creeps).

    torque = f + d_1 v + d_2 v |v| + d_3 v^3,  |f| <= frictionloss

        v             joint velocity [rad/s or m/s]
        f             force of MuJoCo's dry-friction constraint [N m or N]
        frictionloss  limit of f [N m or N], strictly positive
        d_1           damping [N m s/rad or N s/m]
        d_2           quadratic_damping [N m s^2/rad^2 or N s^2/m^2]
        d_3           cubic_damping [N m s^3/rad^3 or N s^3/m^3]

    MuJoCo C has the same polynomial as `damping="d_1 d_2 d_3"` of a joint, and integrates it implicitly with the slope
    at the speed at the start of the step. This model does so in both engines: its `damping` is this slope, and its
    torque the remainder of the polynomial. MJX itself supports d_1 only.

    Source: L. Simoni, M. Beschi, G. Legnani, A. Visioli, "Friction modeling with temperature effects for industrial
    robot manipulators", IROS 2015, for friction as a polynomial of the velocity; MuJoCo documentation, "XML Reference",
    joint, damping.
    """

    physical_parameters = {
        **MujocoDefault.physical_parameters,
        "quadratic_damping": Parameter("damping/velocity", 0.01, 1e-4, 10),
        "cubic_damping": Parameter("damping/velocity^2", 0.01, 1e-4, 10),
    }
    contains = {"mujoco_default": {"quadratic_damping": 0.0, "cubic_damping": 0.0}}
    constraint = True
    dissipative = True
    sees = ("speed", "fast")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the constraint's limit, the polynomial's slope as damping, and the polynomial's remainder."""
        speed = state.qvel * xp.sign(state.qvel)  # not abs, whose slope at 0 differs between torch and JAX
        quadratic, cubic = values["quadratic_damping"] * speed, values["cubic_damping"] * xp.square(speed)
        slope = values["damping"] + 2 * quadratic + 3 * cubic
        remainder = -(quadratic + 2 * cubic) * state.qvel
        return FrictionTerms(torque=remainder, frictionloss=values["frictionloss"], damping=slope)
