"""Friction proportional to the motor torque that builds up over a displacement."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Parameter, Values, register_model
from frictionzoo.models.bristles import remaining, settled

_ROUNDING = 1e-12  # relative size below which a square is rounding, for a finite gradient of its root
_LEAST = 1e-12  # N m or N, gives zero memory to a joint without friction and torque


@register_model("torque_proportional")
class TorqueProportional(FrictionModel):
    """Friction that grows with motor torque, with separate factors for driving and braking, and has presliding.

    Use it for gears that lose a fraction of the motor torque, and another fraction if they are driven backwards.

    Cannot represent: loss by an external torque while the motor is off, a breakaway torque above the sliding torque,
    friction that depends on position. An oscillating load below the limit makes the joint drift.

    dz/dt = (v - |v| z) / h
    torque = (f_c + (k_d + k_b) / 2 |tau_m|) z + (k_d - k_b) / 2 tau_m z^2 + d v

        v      joint velocity [rad/s or m/s]
        z      smooth sign of the friction, between -1 and 1, the model's memory [1]
        tau_m  actuator torque [N m or N]
        h      presliding [rad or m], over which the sign changes
        f_c    coulomb_torque [N m or N], without load
        k_d    load_friction_driving [1], per torque of a motor that drives the motion: at 1 or above it does not move
        k_b    load_friction_braking [1], per torque of a motor that brakes the motion: the gear is driven backwards
        d      viscous_coefficient [N m s/rad or N s/m]
        v_0    rest_velocity [rad/s or m/s], below about which a joint counts as at rest when a rollout starts; known

    In the source, mu_avg is (k_d + k_b) / 2, mu_dif is (k_d - k_b) / 2, and f_c is 0. Any positive k_d and k_b
    dissipate. With k_d = k_b = 0 the model equals `dahl` with the stiffness f_c / h. Under load its stiffness grows and
    the displacement stays; in `dahl_load_dependent` the displacement grows and the stiffness stays.

    At constant velocity the friction is (f_c + k |tau_m|) sign(v) + d v with k = k_d if tau_m v > 0, else k_b. A
    rollout starts with the memory that balances the load if the joint rests, and with the sign of the velocity if it
    moves. Each step integrates the memory exactly for constant velocity and evaluates the torque at the end of the step
    through MuJoCo's implicit damping, so it is stable at any presliding.

    Without other torques, tau_m acts on the sliding joint as (1 - k_d) tau_m or (1 + k_b) tau_m. A common factor of
    both is then not separable from inertia, f_c and d; only presliding separates it. A load proportional to a known
    mass (gravity) also does, unless `torque_gain` is identified too.

    Source: "Torque-proportional loss in dcmotor", github.com/google-deepmind/mujoco, issue 3528, 2026, the equations of
    the comment of 18 September; f_c is this package's.
    """

    physical_parameters = {
        "presliding": Parameter("position", 1e-3, 1e-6, 0.1),
        "coulomb_torque": Parameter("torque", 0.03, 1e-4, 2),
        "load_friction_driving": Parameter("1", 0.02, 1e-4, 0.5),
        "load_friction_braking": Parameter("1", 0.02, 1e-4, 2),  # above 1 in a self-locking gear
        "viscous_coefficient": Parameter("damping", 0.03, 1e-4, 10),
        "rest_velocity": Parameter("velocity", 0.01, 0.001, 0.1, identify=False),  # a property of the measurement
    }
    contains = {
        "dahl": {
            "load_friction_driving": 0.0,
            "load_friction_braking": 0.0,
            "presliding": lambda values: values["coulomb_torque"] / values["stiffness"],
        }
    }
    valleys = {"presliding": (0.1, 10.0)}
    dissipative = True
    sees = ("speed", "load", "reversal")
    memory = 1

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the friction with the memory at the sign of the velocity."""
        even, odd = self._sizes(xp, values, state)
        dry = (even + odd * xp.sign(state.qvel)) * xp.tanh(state.qvel / values["rest_velocity"])
        return FrictionTerms(torque=dry, damping=values["viscous_coefficient"])

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the memory at rest or in steady motion."""
        even, odd = self._sizes(xp, values, state)
        even = even + _LEAST
        asked = state.motor_torque + state.external_torque
        held = xp.minimum(xp.maximum(asked, odd - even), odd + even)
        # Root of even z + odd z^2 = held that is 0 if held is 0; its square is below 0 only by rounding.
        square = xp.maximum(xp.square(even) + 4 * odd * held, _ROUNDING * xp.square(even))
        sign = 2 * held / (even + xp.sqrt(square))
        return settled(xp, state.qvel, values["rest_velocity"], sign, 1.0)[..., None]

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the torque at the end of the step, and the memory."""
        even, odd = self._sizes(xp, values, state)
        decay, slope, sign = _turn(xp, values, state, memory, timestep)
        # One factor of z^2 is evaluated at this velocity, so the torque of the other factor never drives the joint.
        size = even + odd * (decay * sign + slope * state.qvel)
        damping = size * slope + values["viscous_coefficient"]
        return FrictionTerms(torque=size * decay * sign, damping=damping), sign[..., None]

    def advance_midway(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the torque in the middle of the step, and the memory there."""
        even, odd = self._sizes(xp, values, state)
        _, slope, sign = _turn(xp, values, state, memory, timestep)
        size = even + odd * sign
        damping = size * slope + values["viscous_coefficient"]  # its first part brakes only the change of velocity
        return FrictionTerms(torque=size * (sign - slope * state.qvel), damping=damping), sign[..., None]

    def _sizes(self, xp: Any, values: Values, state: DriveState) -> tuple[Any, Any]:
        """Return the coefficients of z and z^2 [N m or N]."""
        driving, braking = values["load_friction_driving"], values["load_friction_braking"]
        even = values["coulomb_torque"] + (driving + braking) / 2 * xp.abs(state.motor_torque)
        return even, (driving - braking) / 2 * state.motor_torque


def _turn(xp: Any, values: Values, state: DriveState, memory: Any, timestep: float) -> tuple[Any, Any, Any]:
    """Return decay and slope of a step of the memory, and the memory after it."""
    decay, reach = remaining(xp, xp.abs(state.qvel) / values["presliding"], timestep)
    slope = reach / values["presliding"]
    return decay, slope, decay * memory[..., 0] + slope * state.qvel
