"""Friction in proportion to the motor's torque that builds up over a displacement."""

from typing import Any

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel, Values, register_model
from frictionzoo.models.bristles import remaining, settled

_ROUNDING = 1e-12  # share of a square below which it is rounding, for a finite gradient of its root
_LEAST = 1e-12  # N m or N, so that a joint without any friction or torque begins with no memory


@register_model("torque_proportional")
class TorqueProportional(FrictionModel):
    """A gear that loses a share of the motor's torque, another if driven backwards, with a memory in place of the sign.

    dz/dt = (v - |v| z) / h
    torque = (f_c + (k_d + k_b) / 2 |tau_m|) z + (k_d - k_b) / 2 tau_m z^2 + d v

        v      joint velocity [rad/s or m/s]
        z      what sign the friction has, between -1 and 1, the law's memory [1]
        tau_m  torque of the actuator [N m or N]
        h      presliding [rad or m], over which the sign changes
        f_c    coulomb_torque [N m or N], without load
        k_d    load_friction_driving [1], per torque of a motor that drives the motion: from 1 on it does not move
        k_b    load_friction_braking [1], per torque of a motor that brakes it: the gear is driven backwards
        d      viscous_coefficient [N m s/rad or N s/m]
        v_0    rest_velocity [rad/s or m/s], up to about which a joint may stand still where a rollout begins; known

    The source's mu_avg is (k_d + k_b) / 2 and its mu_dif (k_d - k_b) / 2; any positive k_d and k_b dissipate. Its law
    is this one with f_c = 0; with k_d = k_b = 0 this one is `dahl`, and h is f_c / s of that one's stiffness s. Under
    load it is the stiffness that grows, not the displacement: `dahl_load_dependent` has it the other way round.

    At constant velocity the law is (f_c + k |tau_m|) sign(v) + d v with k = k_d where tau_m v > 0, else k_b. A rollout
    begins with the memory that holds the drive's load if the joint rests, and with the sign of the velocity if it
    moves. The memory is advanced exactly for a velocity that is constant in a step, and the torque taken at the step's
    end, by way of MuJoCo's implicit damping: no presliding makes the step unstable.

    While it slides without other torques the joint moves by (1 - k_d) tau_m or (1 + k_b) tau_m: no recording of that
    tells a factor of both from inertia, f_c and d, which is then told by presliding alone. A load in proportion to a
    known mass (gravity) tells it; a `torque_gain` that is identified along takes it away again.

    Cannot represent: loss by an external torque while the motor is off, a breakaway torque above the sliding one,
    friction that depends on position. A load that swings below the limit lets the joint drift.

    Source: "Torque-proportional loss in dcmotor", github.com/google-deepmind/mujoco, issue 3528, 2026, the equations of
    the comment of 18 September; f_c is this package's.
    """

    dimensions = {
        "presliding": "position",
        "coulomb_torque": "torque",
        "load_friction_driving": "1",
        "load_friction_braking": "1",
        "viscous_coefficient": "damping",
        "rest_velocity": "velocity",
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
        """The memory at the sign of the velocity."""
        even, odd = self._sizes(xp, values, state)
        dry = (even + odd * xp.sign(state.qvel)) * xp.tanh(state.qvel / values["rest_velocity"])
        return FrictionTerms(torque=dry, damping=values["viscous_coefficient"])

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """The memory of a joint at rest or in steady motion."""
        even, odd = self._sizes(xp, values, state)
        even = even + _LEAST
        asked = state.motor_torque + state.external_torque
        held = xp.minimum(xp.maximum(asked, odd - even), odd + even)
        # The root of even z + odd z^2 = held that is 0 with it; its square is below 0 by rounding at most.
        square = xp.maximum(xp.square(even) + 4 * odd * held, _ROUNDING * xp.square(even))
        sign = 2 * held / (even + xp.sqrt(square))
        return settled(xp, state.qvel, values["rest_velocity"], sign, 1.0)[..., None]

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """The torque at the end of the step."""
        even, odd = self._sizes(xp, values, state)
        decay, reach = remaining(xp, xp.abs(state.qvel) / values["presliding"], timestep)
        slope = reach / values["presliding"]
        sign = decay * memory[..., 0] + slope * state.qvel
        # One factor of the square is that of this velocity, so that the other one's torque never drives the joint.
        size = even + odd * (decay * sign + slope * state.qvel)
        damping = size * slope + values["viscous_coefficient"]
        return FrictionTerms(torque=size * decay * sign, damping=damping), sign[..., None]

    def _sizes(self, xp: Any, values: Values, state: DriveState) -> tuple[Any, Any]:
        """What z and z^2 are multiplied by [N m or N]."""
        driving, braking = values["load_friction_driving"], values["load_friction_braking"]
        even = values["coulomb_torque"] + (driving + braking) / 2 * xp.abs(state.motor_torque)
        return even, (driving - braking) / 2 * state.motor_torque
