"""MuJoCo's joint friction, and a neural network of the actuator's recent torque and velocity."""

from collections.abc import Sequence
from typing import Any, ClassVar

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Params, Values, register_model
from frictionzoo.models.network import SPAN
from frictionzoo.models.residual_network import ResidualNetwork

LONGEST = 1000
"""Largest number of simulation steps in the history."""


class ActuatorModel(ResidualNetwork):
    """Model with a network of the torque and velocity of the actuator, which `target=actuator_net` writes.

    Attributes:
        history: Simulation steps whose torque and velocity are inputs, the present one, 0, first.
    """

    sees: ClassVar[tuple[str, ...]] = ("speed", "slow", "fast", "direction", "load", "reversal")
    count: ClassVar[int] = 2
    export_target = "actuator_net"
    history: Sequence[int] = (0,)

    def signals(self, state: DriveState) -> list[Any]:
        """See `NetworkModel.signals`."""
        return [state.motor_torque, state.qvel]

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the terms as if the state had lasted."""
        return self.advance(xp, values, state, self.settle(xp, values, state), 0.0)[0]


@register_model("actuator_network")
class ActuatorNetwork(ActuatorModel):
    """MuJoCo's dry friction and damping, plus a bounded neural network of the actuator's recent torque and velocity.

    Use it to train the actuator network that Isaac Lab, mjlab and Newton load: `target=actuator_net` writes it. It
    needs no torque sensor, because it is trained through rollouts of positions.

    Cannot represent: dependence on position, temperature or the load's torque, a memory longer than its history,
    coupling between joints, more than c s in addition to the physical part. Within its limit the network may add energy
    to the drive, and absorbs any other error of the simulation. It is valid for one simulation step, `bench.timestep`.

    torque = f + damping v + c s tanh(N(x)),  x = (tau_m(t - k_i h), v(t - k_i h)) for each k_i in history

        f             constraint force: makes the joint stick while |f| < frictionloss; otherwise equals frictionloss
                      and opposes the motion
        frictionloss  limit of the dry friction [N m or N], strictly positive
        damping       viscous coefficient [N m s/rad or N s/m]
        tau_m         torque of the actuator, from its controller and motor [N m or N]
        v             joint velocity [rad/s or m/s]
        h             simulation step [s]
        N             multilayer perceptron. Its inputs are x, minus its mean, divided by its standard deviation in the
                      training data, clipped at 5; the joints share it, and each is evaluated alone
        s             torque_scale [N m or N], standard deviation of the actuator torque in the training data
        c             residual_limit, known

    tau_m is a function of position error and velocity, the inputs of the simulators' actuator networks, for given gains
    and supply. The network therefore learns from recordings with several gains. The torque that drives the joint is
    tau_m - c s tanh(N(x)), and the fit starts as a fit of `mujoco_default`. A rollout assumes a constant state before
    its start.

    Source: J. Hwangbo, J. Lee, A. Dosovitskiy, D. Bellicoso, V. Tsounis, V. Koltun, M. Hutter, "Learning agile and
    dynamic motor skills for legged robots", Science Robotics 4(26), 2019, a network of recent position errors and
    velocities, trained on measured torque; the physical part, the bound and the training through rollouts are this
    package's.

    Args:
        residual_limit: Largest torque of the network, relative to `torque_scale`.
        history: Past simulation steps that the network reads, in ascending order, 0 first.

    Raises:
        ConfigError: The history has no past step, does not ascend from 0, or is too long; see also `ResidualNetwork`.
    """

    def __init__(
        self,
        nv: int,
        hidden: Sequence[int] = (32, 32),
        residual_limit: float = 1.0,
        history: Sequence[int] = (0, 1, 2),
        seed: int = 0,
        params: Params | None = None,
    ) -> None:
        steps = list(history)
        whole = all(isinstance(step, int) and not isinstance(step, bool) for step in steps)
        if not whole or len(steps) < 2 or steps[0] != 0 or steps != sorted({*steps}) or steps[-1] > LONGEST:
            raise ConfigError(
                f"model.history={steps}; expected two whole numbers or more, ascending from 0 to at "
                f"most {LONGEST}, as [0,1,2]"
            )
        self.columns: int = 2 * len(steps)
        super().__init__(nv, hidden, residual_limit, seed, params)
        self.history: Sequence[int] = steps
        self.memory: int = 2 * steps[-1]

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return torque and velocity of each past step, the newest first, as if the state had lasted."""
        return xp.concatenate([xp.stack(self.signals(state), -1)] * (1 + self.history[-1]), -1)[..., : self.memory]

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the terms with the past steps in memory, and the memory with this step."""
        window = xp.concatenate([xp.stack(self.signals(state), -1), memory], -1)
        picked = [(window[..., 2 * k : 2 * k + 2] - values["input_mean"]) / values["input_std"] for k in self.history]
        x = xp.clip(xp.concatenate(picked, -1), -SPAN, SPAN)
        return self.terms_of(xp, values, x), window[..., : self.memory]
