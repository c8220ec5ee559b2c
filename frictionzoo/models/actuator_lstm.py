"""MuJoCo's joint friction, and a recurrent network of the actuator's torque and velocity."""

from collections.abc import Sequence
from typing import Any

import torch

from frictionzoo.core.errors import refuse_outside
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Params, Values, register_model
from frictionzoo.models.actuator_network import ActuatorModel
from frictionzoo.models.network import MOST_WIDTH, draw_linear, sigmoid

KEPT = 5.0
"""Largest initial bias of the forget gates, for memories of 2 to 150 steps."""


@register_model("actuator_lstm")
class ActuatorLSTM(ActuatorModel):
    """MuJoCo's dry friction and damping, plus a bounded recurrent network of the actuator's torque and velocity.

    Use it to train the recurrent actuator network that Isaac Lab's `ActuatorNetLSTM` loads: `target=actuator_net`
    writes it. It needs no torque sensor, because it is trained through rollouts of positions. Unlike
    `actuator_network`, its memory has no fixed length, so it can learn presliding and slow changes.

    Cannot represent: dependence on position, temperature or the load's torque, coupling between joints, more than c s
    in addition to the physical part. Within its limit the network may add energy to the drive, and absorbs any other
    error of the simulation. It is valid for one simulation step, `bench.timestep`.

    torque = f + damping v + c s tanh(N(h, x)),  h_i = sigmoid(o_i(x)) tanh(m_i),  x = (tau_m, v)
    m_i(t) = k_i m_i(t - dt) + (1 - k_i) tanh(g_i(x)),  k_i = sigmoid(b_i(x, h(t - dt)))

        f             constraint force: makes the joint stick while |f| < frictionloss; otherwise equals frictionloss
                      and opposes the motion
        frictionloss  limit of the dry friction [N m or N], strictly positive
        damping       viscous coefficient [N m s/rad or N s/m]
        tau_m         torque of the actuator, from its controller and motor [N m or N]
        v             joint velocity [rad/s or m/s]
        x             inputs: tau_m and v, minus their mean, divided by their standard deviation in the training data,
                      clipped at 5
        m_i           cell of unit i, n = units per joint; with h, the model's memory
        h_i           output of unit i
        k_i           forget gate of unit i: the fraction of the cell that a step dt keeps
        g, o, b       linear functions
        N             multilayer perceptron; the joints share all weights, and each is evaluated alone
        s             torque_scale [N m or N], standard deviation of the actuator torque in the training data
        c             residual_limit, known

    This is a long short-term memory whose input gate is 1 - k_i and whose g and o do not depend on h. Each cell
    therefore settles at tanh(g_i(x)) for constant x, and a rollout starts there. How fast a cell changes depends on h,
    as for springs that slip at a limit of their force. The initial memories last for about 2 to 150 steps. They are
    learned within segments: short segments contain no information about a long memory.

    tau_m is a function of position error and velocity, the inputs of the simulators' actuator networks, for given gains
    and supply. The torque that drives the joint is tau_m - c s tanh(N(h, x)), and the fit starts as a fit of
    `mujoco_default`.

    Source: N. Rudin, D. Hoeller, P. Reist, M. Hutter, "Learning to Walk in Minutes Using Massively Parallel Deep
    Reinforcement Learning", CoRL 2021, an actuator network with this memory; coupled input and forget gates: K. Greff,
    R. K. Srivastava, J. Koutnik, B. R. Steunebrink, J. Schmidhuber, "LSTM: A Search Space Odyssey", IEEE Transactions
    on Neural Networks and Learning Systems 28(10), 2017; the other gates, the physical part, the bound and the training
    through rollouts are this package's.

    Args:
        hidden: Width of each hidden layer of N.
        residual_limit: Largest torque of the network, relative to `torque_scale`.
        units: Number of units per joint.

    Raises:
        ConfigError: There is no unit, or there are too many; see also `ResidualNetwork`.
    """

    def __init__(
        self,
        nv: int,
        hidden: Sequence[int] = (32,),
        residual_limit: float = 1.0,
        units: int = 8,
        seed: int = 0,
        params: Params | None = None,
    ) -> None:
        refuse_outside("model.units", units, 1, MOST_WIDTH)
        self.columns: int = units + 2
        super().__init__(nv, hidden, residual_limit, seed, params)
        self.units: int = units
        self.memory: int = 2 * units
        generator = torch.Generator().manual_seed(seed + 1)
        self.gates: torch.nn.Linear = draw_linear(2, 2 * units, generator)
        self.forget: torch.nn.Linear = draw_linear(units + 2, units, generator)
        with torch.no_grad():
            self.forget.bias.copy_(torch.linspace(0, KEPT, units))

    def settle(self, xp: Any, values: Values, state: DriveState) -> Any:
        """Return outputs and cells, the steady state for a constant state."""
        candidate, output = self.open_gates(xp, values, self.bounded(xp, values, state))
        return xp.concatenate([output * xp.tanh(candidate), candidate], -1)

    def advance(
        self, xp: Any, values: Values, state: DriveState, memory: Any, timestep: float
    ) -> tuple[FrictionTerms, Any]:
        """Return the terms with the memory in this state, and that memory."""
        x, before, cell = self.bounded(xp, values, state), memory[..., : self.units], memory[..., self.units :]
        candidate, output = self.open_gates(xp, values, x)
        kept = xp.matmul(xp.concatenate([x, before], -1), values["forget.weight"].T) + values["forget.bias"]
        cell = candidate + sigmoid(xp, kept) * (cell - candidate)
        after = output * xp.tanh(cell)
        return self.terms_of(xp, values, xp.concatenate([after, x], -1)), xp.concatenate([after, cell], -1)

    def open_gates(self, xp: Any, values: Values, x: Any) -> tuple[Any, Any]:
        """Return the candidates of the cells and the output gates, each of shape (..., nv, units)."""
        answer = xp.matmul(x, values["gates.weight"].T) + values["gates.bias"]
        return xp.tanh(answer[..., : self.units]), sigmoid(xp, answer[..., self.units :])
