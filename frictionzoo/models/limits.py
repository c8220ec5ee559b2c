"""Terms of state-dependent limits of dry friction."""

from typing import Any

from frictionzoo.core.state import DriveState
from frictionzoo.models.base import Values

_AT_REST = 1e-12  # keeps logarithm and slope finite at v = 0; the factor there is 1 - 1e-6 for an exponent of 1
_GONE = 5.0  # exp(-exp(5)) = 4e-65; larger values overflow in float32


def stribeck_share(xp: Any, values: Values, qvel: Any) -> Any:
    """Return the Stribeck factor exp(-|v / v_s|^alpha) [1] at a joint velocity, 1 at rest and 0 at high speed."""
    power = values["stribeck_exponent"] / 2 * xp.log(xp.square(qvel / values["stribeck_velocity"]) + _AT_REST)
    return xp.exp(-xp.exp(xp.where(power < _GONE, power, _GONE)))


def ripple_share(xp: Any, values: Values, qpos: Any) -> Any:
    """Return the ripple of friction over the position relative to its mean, as in meshing gears: two harmonics.

    s_1 sin(n q) + c_1 cos(n q) + s_2 sin(2 n q) + c_2 cos(2 n q)

    n are the periods [1/rad or 1/m], s_i and c_i the amplitudes [1], and q is the position [rad or m]. Sine and cosine
    instead of amplitude and phase keep the limit linear in the parameters: no local minima, no phase jumps.
    """
    phase = values["periods"] * qpos
    first_harmonic = values["sine_1"] * xp.sin(phase) + values["cosine_1"] * xp.cos(phase)
    return first_harmonic + values["sine_2"] * xp.sin(2 * phase) + values["cosine_2"] * xp.cos(2 * phase)


def gear_load(xp: Any, state: DriveState, motor: Any, external: Any) -> Any:
    """Return the friction torque of a loaded gear, |k_m tau_m - k_e tau_e| [N m or N].

    Both torques act on the joint, with the same sign convention. A motor that holds a weight has tau_m = -tau_e: the
    gear load is their difference, while their sum is 0. Between a motor of inertia J_m and a load of inertia J_l, the
    gear transmits (J_l tau_m - J_m tau_e) / (J_m + J_l): half the difference if both inertias are equal, tau_m at rest.
    k_m is the friction per motor torque and k_e the friction per external torque [1].
    """
    return xp.abs(motor * state.motor_torque - external * state.external_torque)


def directional_limit(xp: Any, values: Values, state: DriveState) -> Any:
    """Return the terms that load and standstill add to the limit of dry friction [N m or N].

    |k_m tau_m - k_e tau_e| + (s + |l_m tau_m - l_e tau_e|) exp(-|v / v_s|^alpha), with the values of `Directional`
    """
    share = stribeck_share(xp, values, state.qvel)
    load = gear_load(xp, state, values["load_friction_motor"], values["load_friction_external"])
    at_rest = gear_load(xp, state, values["stribeck_load_friction_motor"], values["stribeck_load_friction_external"])
    return load + share * (values["stribeck_torque"] + at_rest)
