"""Dry and viscous friction that change linearly with the temperature."""

from typing import Any

from frictionzoo.models import Parameter, Values, register_model
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.models.temperature import TemperatureModel

_LEAST = 0.05  # smallest factor: at a limit of 0 MuJoCo locks the joint


@register_model("temperature_linear")
class TemperatureLinear(TemperatureModel):
    """Dry friction as MuJoCo's constraint and viscous friction, both linear in the temperature.

    Use it if the recorded temperature varies little; over tens of kelvins use `temperature_arrhenius`.

    Cannot represent: a coefficient that is nonlinear in the temperature, as viscosity over tens of kelvins; a lubricant
    whose temperature differs from the recorded one, for example because it lags the motor's; a breakaway torque above
    the sliding torque; friction that depends on direction, load or position; true sticking (MuJoCo's constraint
    creeps).

    torque = f + damping (1 + b (T - T_0)) v,  |f| <= frictionloss (1 + a (T - T_0))

        v             joint velocity [rad/s or m/s]
        f             force of MuJoCo's dry-friction constraint [N m or N]
        T             recorded temperature [degC]
        T_0           reference [degC], known; without a recorded temperature T = T_0
        frictionloss  limit of the dry friction at T_0 [N m or N], strictly positive
        damping       viscous coefficient at T_0 [N m s/rad or N s/m]
        a             frictionloss_slope [1/K], relative change of frictionloss per kelvin
        b             damping_slope [1/K], relative change of damping per kelvin

    The factors are at least 0.05, which keeps both coefficients strictly positive; with bounds of 0.05/K a factor
    reaches 0.05 at 19 K from T_0 at the earliest.

    Source: A. Carvalho Bittencourt, S. Gunnarsson, "Static Friction in a Robot Joint - Modeling and Identification of
    Load and Temperature Effects", Journal of Dynamic Systems, Measurement, and Control 134(5), 2012, on friction terms
    that grow or fall with the temperature; this model omits their Stribeck and load terms.
    """

    physical_parameters = {
        **MujocoDefault.physical_parameters,
        "frictionloss_slope": Parameter("1/temperature", 0.0, -0.05, 0.05, 0.01),
        "damping_slope": Parameter("1/temperature", 0.0, -0.05, 0.05, 0.01),
    }
    contains = {"mujoco_default": {"frictionloss_slope": 0.0, "damping_slope": 0.0}}

    def shares(self, xp: Any, values: Values, temperature: Any) -> tuple[Any, Any]:
        """See `TemperatureModel.shares`."""
        warmer = temperature - self.reference
        dry, viscous = 1 + values["frictionloss_slope"] * warmer, 1 + values["damping_slope"] * warmer
        return xp.where(dry > _LEAST, dry, _LEAST), xp.where(viscous > _LEAST, viscous, _LEAST)
