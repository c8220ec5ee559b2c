"""MuJoCo's own joint friction, and a small neural network for what it leaves."""

from collections.abc import Sequence
from typing import Any

import torch

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import Params, Values, register_model
from frictionzoo.models.network import NetworkModel


@register_model("residual_network")
class ResidualNetwork(NetworkModel):
    """MuJoCo's dry friction and damping, identified, and a bounded neural network on top.

    torque = f + damping v + c s tanh(N(x)),  x = (q, v, a, tau_e)

        f             the constraint's force: whatever makes the joint stick while |f| < frictionloss, and frictionloss
                      against the motion otherwise
        frictionloss  limit of the dry friction [N m or N], strictly positive
        damping       viscous coefficient [N m s/rad or N s/m]
        q             joint position [rad or m]
        v             joint velocity [rad/s or m/s]
        a             command of the joint's actuator, in the actuator's unit
        tau_e         external torque [N m or N]
        N             multilayer perceptron of the inputs less their mean, over their standard deviation in the training
                      data, and held within 5 of them; the joints share it, and each is seen alone
        s             torque_scale [N m or N], standard deviation of the actuator's torque in the training data
        c             residual_limit, known

    The physical part is `mujoco_default` and not `coulomb_stribeck`, because a constraint can hold the joint and the
    smooth sign of an explicit torque cannot: at rest f takes up the network's torque with any other load. The network's
    part alone is `FrictionTerms.torque`; the rest is in `frictionloss` and `damping`.

    Guarantees, whatever finite weights a fit finds and wherever the drive is:

        |network's part| <= c s, because |tanh| <= 1: also outside the training data, friction is the physical law's
            but for that.
        The drive gets at most the power c s |v|: the physical part gives none.
        The joint sticks where the network's part and all load together stay below frictionloss, as far as MuJoCo's
            constraint makes it.

    The network starts near zero: the fit begins as that of `mujoco_default`.

    Cannot represent: friction with a memory, coupling between joints, more than c s beside the physical law. With
    MuJoCo's default `solref` the constraint creeps, viscous at very low speed. Within its limit the network may give
    energy to the drive, and takes up any other error of the simulation; what it and the physical parameters can both
    explain, the data do not divide between them.

    Source: equation of this package; physical part: E. Todorov, T. Erez, Y. Tassa, "MuJoCo: A physics engine for
    model-based control", IROS 2012.

    Args:
        residual_limit: Largest part of the network, as a share of `torque_scale`.

    Raises:
        ConfigError: The limit is not positive, and as `NetworkModel` has it.
    """

    dimensions = {"frictionloss": "torque", "damping": "damping"}
    constraint = True
    residual_limit: torch.Tensor

    def __init__(
        self, nv: int, hidden: Sequence[int], residual_limit: float, seed: int, params: Params | None = None
    ) -> None:
        super().__init__(nv, hidden, 1, seed, params)
        if not 0 < residual_limit < float("inf"):
            raise ConfigError(f"model.residual_limit={residual_limit}; expected a positive share of the drive's torque")
        # With the values, since the limit is part of the law, and torch's ONNX exporter rounds a number to float32.
        self.register_buffer("residual_limit", torch.tensor(float(residual_limit), dtype=torch.float64))

    def terms(self, xp: Any, values: Values, state: DriveState) -> FrictionTerms:
        """The network's torque, the constraint's limit and the damping."""
        share = xp.tanh(self.network(xp, values, self.bounded(xp, values, state))[..., 0])
        residual = values["residual_limit"] * values["torque_scale"] * share
        return FrictionTerms(residual, values["frictionloss"], values["damping"])
