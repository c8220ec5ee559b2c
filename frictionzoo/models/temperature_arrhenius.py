"""Dry and viscous friction with the temperature dependence of a lubricant's viscosity."""

from typing import Any

from frictionzoo.models import Parameter, Values, register_model
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.models.temperature import ABSOLUTE_ZERO, TemperatureModel


@register_model("temperature_arrhenius")
class TemperatureArrhenius(TemperatureModel):
    """Dry friction as MuJoCo's constraint and viscous friction, each with an Arrhenius factor of the temperature.

    Use it if the recorded temperature varies, also over tens of kelvins.

    Cannot represent: friction with a minimum over the temperature; a lubricant whose temperature differs from the
    recorded one, for example because it lags the motor's; a breakaway torque above the sliding torque; friction that
    depends on direction, load or position; true sticking (MuJoCo's constraint creeps).

    torque = f + damping A(D) v,  |f| <= frictionloss A(F),  A(E) = exp(E (1/T - 1/T_0))

        v             joint velocity [rad/s or m/s]
        f             force of MuJoCo's dry-friction constraint [N m or N]
        T             absolute temperature [K]; recordings have it in degC
        T_0           reference, known; without a recorded temperature T = T_0
        frictionloss  limit of the dry friction at T_0 [N m or N], strictly positive
        damping       viscous coefficient at T_0 [N m s/rad or N s/m]
        F             frictionloss_activation [K], activation temperature: activation energy over gas constant
        D             damping_activation [K], the same for damping; 1000 K are 8.314 kJ/mol

    With a positive activation temperature, friction falls as the drive warms up. Both coefficients are positive at any
    temperature.

    Source: E. N. da C. Andrade, "The Viscosity of Liquids", Nature 125, 1930, A exp(b / T) for the viscosity; A.
    Carvalho Bittencourt, S. Gunnarsson, "Static Friction in a Robot Joint - Modeling and Identification of Load and
    Temperature Effects", Journal of Dynamic Systems, Measurement, and Control 134(5), 2012, for a robot's viscous
    friction that falls exponentially with the temperature.
    """

    physical_parameters = {
        **MujocoDefault.physical_parameters,
        "frictionloss_activation": Parameter("temperature", 0.0, -10000.0, 10000.0, 1000.0),
        "damping_activation": Parameter("temperature", 0.0, -10000.0, 10000.0, 1000.0),
    }
    contains = {"mujoco_default": {"frictionloss_activation": 0.0, "damping_activation": 0.0}}

    def shares(self, xp: Any, values: Values, temperature: Any) -> tuple[Any, Any]:
        """See `TemperatureModel.shares`."""
        # 1/T - 1/T_0 without cancellation in float32.
        absolute, reference = temperature - ABSOLUTE_ZERO, self.reference - ABSOLUTE_ZERO
        colder = (self.reference - temperature) / (absolute * reference)
        return xp.exp(values["frictionloss_activation"] * colder), xp.exp(values["damping_activation"] * colder)
