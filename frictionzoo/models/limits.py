"""What state-dependent limits of dry friction are added up from."""

from typing import Any

from frictionzoo.core.state import DriveState
from frictionzoo.models.base import Values

_AT_REST = 1e-12  # keeps the logarithm and the slope finite at v = 0; the share there is 1 - 1e-6 with an exponent of 1
_GONE = 5.0  # exp(-exp(5)) = 4e-65; further on float32 overflows


def stribeck_share(xp: Any, qvel: Any, velocity: Any, exponent: Any) -> Any:
    """Share of what is added to friction at rest, 1 at rest and 0 at speed: exp(-|v / v_s|^alpha).

    Of the joint's velocity v and the Stribeck velocity v_s [rad/s or m/s], and the exponent alpha [1].
    """
    power = exponent / 2 * xp.log(xp.square(qvel / velocity) + _AT_REST)
    return xp.exp(-xp.exp(xp.where(power < _GONE, power, _GONE)))


def ripple_share(xp: Any, values: Values, qpos: Any) -> Any:
    """What meshing gears change in friction over the position, as a share of its mean: two harmonics.

    s_1 sin(n q) + c_1 cos(n q) + s_2 sin(2 n q) + c_2 cos(2 n q)

    Sine and cosine rather than amplitude and phase: the limit is linear in them, so that a fit finds no local minimum
    and no phase that jumps. Of periods n [1/rad or 1/m], the shares s_i and c_i [1] and the position q [rad or m].
    """
    phase = values["periods"] * qpos
    first = values["sine_1"] * xp.sin(phase) + values["cosine_1"] * xp.cos(phase)
    return first + values["sine_2"] * xp.sin(2 * phase) + values["cosine_2"] * xp.cos(2 * phase)


def gear_load(xp: Any, state: DriveState, motor: Any, external: Any) -> Any:
    """Friction torque of a loaded gear, |k_m tau_m - k_e tau_e| [N m or N].

    Both torques act on the joint and count in its direction. A motor that holds a weight has tau_m = -tau_e: the load
    on the gear is then their difference, not their sum, which is 0. Between a motor of inertia J_m and a load of
    inertia J_l, the gear passes on (J_l tau_m - J_m tau_e) / (J_m + J_l): half the difference where both are equal,
    tau_m at rest. Friction per torque of the motor is k_m, per external torque k_e [1].
    """
    return xp.abs(motor * state.motor_torque - external * state.external_torque)


def directional_limit(xp: Any, values: Values, state: DriveState) -> Any:
    """What load and standstill add to the limit of dry friction [N m or N].

    |k_m tau_m - k_e tau_e| + (s + |l_m tau_m - l_e tau_e|) exp(-|v / v_s|^alpha), of values as `Directional` has them
    """
    share = stribeck_share(xp, state.qvel, values["stribeck_velocity"], values["stribeck_exponent"])
    load = gear_load(xp, state, values["load_friction_motor"], values["load_friction_external"])
    at_rest = gear_load(xp, state, values["stribeck_load_friction_motor"], values["stribeck_load_friction_external"])
    return load + share * (values["stribeck_torque"] + at_rest)


def quadratic_gear_load(xp: Any, state: DriveState, motor: Any, external: Any) -> Any:
    """Friction torque of a gear whose two sides oppose each other, by the square of the weaker one [N m or N].

    q_e tau_e^2 where the motor is the stronger, q_m tau_m^2 where it is driven, 0 where both push the same way; q_m
    and q_e [1/(N m) or 1/N].
    """
    driving = xp.abs(state.external_torque) < xp.abs(state.motor_torque)
    weaker = xp.where(driving, external * xp.square(state.external_torque), motor * xp.square(state.motor_torque))
    return xp.where(state.motor_torque * state.external_torque < 0, weaker, 0.0)
