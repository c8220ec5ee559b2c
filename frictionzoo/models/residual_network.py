"""MuJoCo's joint friction, and a small neural network for its residual."""

from collections.abc import Sequence
from typing import Any

import torch

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Params, Values, register_model
from frictionzoo.models.mujoco_default import MujocoDefault
from frictionzoo.models.network import NetworkModel


@register_model("residual_network")
class ResidualNetwork(NetworkModel):
    """MuJoCo's dry friction and damping, plus a bounded neural network.

    Use it if `mujoco_default` leaves a small residual torque that no formula explains, and the joint must stick.

    Cannot represent: friction with a memory, coupling between joints, more than c s in addition to the physical part,
    true sticking: with MuJoCo's default `solref` the constraint creeps, viscous at very low speed. Within its limit the
    network may add energy to the drive, and absorbs any other error of the simulation. The data do not separate effects
    that both the network and the physical parameters can explain.

    torque = f + damping v + c s tanh(N(x)),  x = (q, v, a, tau_e)

        f             constraint force: makes the joint stick while |f| < frictionloss; otherwise equals frictionloss
                      and opposes the motion
        frictionloss  limit of the dry friction [N m or N], strictly positive
        damping       viscous coefficient [N m s/rad or N s/m]
        q             joint position [rad or m]
        v             joint velocity [rad/s or m/s]
        a             command of the joint's actuator, in the actuator's unit
        tau_e         external torque [N m or N]
        N             multilayer perceptron. Its inputs are x, minus its mean, divided by its standard deviation in the
                      training data, clipped at 5; the joints share it, and each is evaluated alone
        s             torque_scale [N m or N], standard deviation of the actuator torque in the training data
        c             residual_limit, known

    The physical part is `mujoco_default` and not `coulomb_stribeck`, because a constraint can hold the joint and an
    explicit torque with a smooth sign cannot: at rest f balances the network's torque as any other load. The network's
    torque is `FrictionTerms.torque`; the physical part is in `frictionloss` and `damping`.

    Guarantees, for any finite weights and any state of the drive:

        |network's part| <= c s, because |tanh| <= 1: also outside the training data, friction differs from the physical
            part by no more than this.
        The network adds at most the power c s |v| to the drive; the physical part adds none.
        The joint sticks while the network's torque and all loads together stay below frictionloss, as far as MuJoCo's
            constraint allows.

    The network starts near zero: the fit starts as a fit of `mujoco_default`.

    Source: equation of this package; physical part: E. Todorov, T. Erez, Y. Tassa, "MuJoCo: A physics engine for
    model-based control", IROS 2012.

    Args:
        residual_limit: Largest torque of the network, relative to `torque_scale`.

    Raises:
        ConfigError: The limit is not positive; see also `NetworkModel`.
    """

    physical_parameters = MujocoDefault.physical_parameters
    constraint = True
    residual_limit: torch.Tensor

    def __init__(
        self,
        nv: int,
        hidden: Sequence[int] = (16, 16),
        residual_limit: float = 0.2,
        seed: int = 0,
        params: Params | None = None,
    ) -> None:
        super().__init__(nv, hidden, 1, seed, params)
        if not 0 < residual_limit < float("inf"):
            raise ConfigError(f"model.residual_limit={residual_limit}; expected a positive share of the drive's torque")
        # Saved with the values: the limit is part of the model, and torch's ONNX exporter rounds numbers to float32.
        self.register_buffer("residual_limit", torch.tensor(float(residual_limit), dtype=torch.float64))

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """Return the network's torque, the constraint's limit and the damping."""
        return self.terms_of(xp, values, self.bounded(xp, values, state))

    def terms_of(self, xp: Any, values: Values, x: Any) -> FrictionTerms:
        """Return the terms for inputs of the network, of shape (..., nv, columns)."""
        residual = values["residual_limit"] * values["torque_scale"] * xp.tanh(self.network(xp, values, x)[..., 0])
        return FrictionTerms(residual, values["frictionloss"], values["damping"])
