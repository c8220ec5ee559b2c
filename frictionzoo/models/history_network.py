"""Friction as a neural network with memory."""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch

from frictionzoo.core.errors import ConfigError, refuse_outside
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Values, register_model
from frictionzoo.models.network import MOST_WIDTH, NetworkModel, sigmoid


@register_model("history_network")
class HistoryNetwork(NetworkModel):
    """Gated recurrent unit in continuous time: friction may depend on the past motion.

    Use it if friction depends on the past and no formula is known.

    Cannot represent: sticking, coupling between joints, a memory whose rate depends on the memory itself, such as
    elements that slip at a limit of their force. It does not extrapolate outside the training data, may add energy to
    the drive, and absorbs any other error of the simulation, including lags of motor and sensors.

    torque = s (N_0(x) + h_1 + ... + h_n),  dh_i/dt = (N_i(x) - h_i) / t_i(x),  x = (q, v, a, tau_e)
    t_i(x) = t_long (t_short / t_long)^sigmoid(N_(n+i)(x))

        q       joint position [rad or m]
        v       joint velocity [rad/s or m/s]
        a       command of the joint's actuator, in the actuator's unit
        tau_e   external torque [N m or N]
        N       multilayer perceptron with 1 + 2 n outputs. Its inputs are x, minus its mean, divided by its standard
                deviation in the training data, clipped at 5; the joints share it, and each is evaluated alone
        h_i     the model's memory, n = memory values per joint
        t_i     time constant of h_i [s], between t_short and t_long, which are known
        s       torque_scale [N m or N], standard deviation of the actuator torque in the training data

    In a step dt, h_i approaches N_i by the fraction 1 - exp(-dt / t_i). This is the exact solution for constant x, and
    a gated recurrent unit with this fraction as its update gate. The memory therefore refers to time, not to steps:
    with another time step the model stays the same, except for an error of first order in the step. N_i and t_i depend
    on x and not on h, so N_i(x) is also the steady state for constant x, with which a rollout starts. There the
    friction is s (N_0 + N_1 + ... + N_n), a network without memory.

    Dahl's spring that yields is a special case, t_1 = f_c / (stiffness |v|) and N_1 = f_c sign(v) / s.

    Torque starts near zero, and the initial time constants are evenly spaced on a logarithmic scale. The memory is
    learned within segments: segments of 5 ms contain no information about a time constant of 1 s.

    Source: L. Feng, F. Tung, M. O. Ahmed, Y. Bengio, H. Hajimirsadeghi, "Were RNNs All We Needed?", 2024, minGRU: a
    gated recurrent unit whose gate and candidate depend on the inputs alone; time constants that depend on the inputs:
    R. Hasani, M. Lechner, A. Amini, D. Rus, R. Grosu, "Liquid Time-constant Networks", AAAI 2021. V. Kovalev et al.,
    Proc. MIPT 18(2), 2026, suggest a short history of states; this form is this package's.

    Args:
        memory: Number of memory values per joint.
        time_constants: t_short and t_long [s].

    Raises:
        ConfigError: A width is below 1, there is no memory, or the time constants are not two positive numbers, the
            shorter first.
    """

    sees: ClassVar[tuple[str, ...]] = (*NetworkModel.sees, "reversal")
    time_constants: torch.Tensor

    def __init__(
        self,
        nv: int,
        hidden: Sequence[int] = (64, 64),
        memory: int = 8,
        time_constants: Sequence[float] = (0.002, 2.0),
        seed: int = 0,
    ) -> None:
        refuse_outside("model.memory", memory, 1, MOST_WIDTH)
        super().__init__(nv, hidden, 1 + 2 * memory, seed)
        if len(time_constants) != 2 or not 0 < time_constants[0] < time_constants[1] < float("inf"):
            raise ConfigError(f"model.time_constants={list(time_constants)}; expected two above 0 s, the shorter first")
        self.memory = memory
        # Saved with the values, because the bounds are part of the model.
        self.register_buffer("time_constants", torch.tensor(list(time_constants), dtype=torch.float64))
        shares = (torch.arange(memory, dtype=torch.float64) + 0.5) / memory
        with torch.no_grad():
            self.layers[-1].get_parameter("bias")[1 + memory :] = torch.logit(shares)

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the explicit torque with settled memory."""
        return self._torque(xp, values, *self._answer(xp, values, state)[:2])

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return the candidates, the steady state of the memory for a constant state."""
        return self._answer(xp, values, state)[1]

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the explicit torque with the memory in this state, and that memory."""
        present, candidate, gate = self._answer(xp, values, state)
        short, long = values["time_constants"][0], values["time_constants"][1]
        time = long * xp.exp(sigmoid(xp, gate) * xp.log(short / long))
        memory = memory - xp.expm1(-timestep / time) * (candidate - memory)
        return self._torque(xp, values, present, memory), memory

    def _answer(self, xp: Any, values: Values, state: DriveState) -> tuple[Any, Any, Any]:
        """Return the instantaneous part, and the candidate and gate of each unit."""
        answer, split = self.network(xp, values, self.bounded(xp, values, state)), 1 + self.memory
        return answer[..., 0], answer[..., 1:split], answer[..., split:]

    def _torque(self, xp: Any, values: Values, present: Any, memory: Any) -> FrictionTerms:
        return FrictionTerms(torque=values["torque_scale"] * (present + xp.sum(memory, -1)))
