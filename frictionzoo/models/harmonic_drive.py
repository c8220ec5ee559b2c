"""Dry friction of a loaded gear with position-dependent meshing and the Stribeck effect, as a constraint."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.directional import Directional
from frictionzoo.models.limits import directional_limit, ripple_share
from frictionzoo.models.ripple import Ripple

_LEAST = 1e-3  # relative to frictionloss; at a limit of 0 MuJoCo locks the joint


@register_model("harmonic_drive")
class HarmonicDrive(FrictionModel):
    """Dry friction of a gear that depends on load, speed and position, as in harmonic drives and worn spur gears.

    Use it for gears whose friction also changes with the position: `directional` with a limit that follows the
    position, and viscous friction that grows faster than the speed.

    Cannot represent: ripple of the motor torque (cogging), which does not change sign with the direction; the
    compliance of the flexspline; friction that lags the velocity.

    torque = F + d v + d_3 v^3
    |F| <= f (1 + r(q)) + |k_m tau_m - k_e tau_e| + (s + |l_m tau_m - l_e tau_e|) exp(-|v / v_s|^alpha)
    r(q) = s_1 sin(n q) + c_1 cos(n q) + s_2 sin(2 n q) + c_2 cos(2 n q)

    F is the force of MuJoCo's dry-friction constraint. Its limit never falls below f / 1000.

        q, v      joint position [rad or m] and velocity [rad/s or m/s]
        tau_m     actuator torque [N m or N]
        tau_e     external torque [N m or N]: all torques except actuator and friction, same sign convention as tau_m
        f         frictionloss [N m or N], mean over the position, without load and well above v_s; strictly positive
        n         periods [1/rad or 1/m], a property of the gear; known by default, see `ripple`
        s_i, c_i  sine_1, cosine_1, sine_2, cosine_2 [1], relative to f
        k_m, k_e  load_friction_motor, load_friction_external [1]
        l_m, l_e  stribeck_load_friction_motor, stribeck_load_friction_external [1], additional load friction at rest
        s         stribeck_torque [N m or N], additional limit at rest
        v_s       stribeck_velocity [rad/s or m/s], over which s, l_m and l_e decay
        alpha     stribeck_exponent [1]: 2 is a bell, a large value a step at v_s
        d         damping [N m s/rad or N s/m]
        d_3       cubic_damping [N m s^3/rad^3 or N s^3/m^3]

    If the drive moves over less than a tenth of a period, ripple and frictionloss are not separable.

    Rollouts of 5 steps hardly separate its many parameters from noise. Use longer ones, and also fit the delay of the
    command, because armature and damping would absorb it:
    `python -m frictionzoo.run model=harmonic_drive fit=lm segments.length=100 bench.params.delay.identify=true`.

    Source: T. D. Tuttle, W. P. Seering, "A nonlinear model of a harmonic drive gear transmission", IEEE Transactions on
    Robotics and Automation 12(3), 1996, on friction over the position and with the cube of the speed; H. D. Taghirad,
    P. R. Belanger, "Modeling and Parameter Identification of Harmonic Drive Systems", Journal of Dynamic Systems,
    Measurement, and Control 120(4), 1998, on friction by load; M. Duclusaud, G. Passault, V. Padois, O. Ly, "Extended
    friction models for the physics simulation of servo actuators", 2024, for the terms of the limit.
    """

    physical_parameters = {
        **Directional.physical_parameters,
        **Ripple.physical_parameters,
        "sine_1": Parameter("1", 0.0, -0.95, 0.95, 0.1),
        "cosine_1": Parameter("1", 0.0, -0.95, 0.95, 0.1),
        "sine_2": Parameter("1", 0.0, -0.95, 0.95, 0.1),
        "cosine_2": Parameter("1", 0.0, -0.95, 0.95, 0.1),
        "cubic_damping": Parameter("damping/velocity^2", 0.01, 1e-4, 10),
    }
    contains = {
        "directional": {"sine_1": 0.0, "cosine_1": 0.0, "sine_2": 0.0, "cosine_2": 0.0, "cubic_damping": 0.0},
        "ripple": {
            "load_friction_motor": 0.0,
            "load_friction_external": 0.0,
            "stribeck_load_friction_motor": 0.0,
            "stribeck_load_friction_external": 0.0,
            "stribeck_torque": 0.0,
            "cubic_damping": 0.0,
        },
    }
    valleys = {"stribeck_velocity": (0.3, 3.0)}
    constraint = True
    dissipative = True
    sees = ("speed", "slow", "fast", "load", "position")

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the limit in this state, the viscous part's slope as damping, and that part's remainder."""
        meshing = values["frictionloss"] * (1 + ripple_share(xp, values, state.qpos))
        limit, least = meshing + directional_limit(xp, values, state), _LEAST * values["frictionloss"]
        cubic = values["cubic_damping"] * xp.square(state.qvel)
        return FrictionTerms(
            torque=-2 * cubic * state.qvel,
            frictionloss=xp.where(limit > least, limit, least),
            damping=values["damping"] + 3 * cubic,
        )
