"""Friction laws that exist only in torch."""

import torch

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import CoulombStribeck, TorchFriction

DRY = {"dry": {"init": 0.1, "low": 0.01, "high": 1.0, "scale": "log", "identify": True}}
STRIBECK = "helpers.torch_laws.TorchStribeck"


class TorchStribeck(TorchFriction):
    """`coulomb_stribeck`, written again in torch alone."""

    dimensions = CoulombStribeck.dimensions
    dissipative = True

    def forward(self, state: DriveState) -> FrictionTerms:
        share = torch.exp(-((state.qvel / self.stribeck_velocity) ** 2))
        dry = torch.lerp(self.kinetic_torque.expand_as(share), self.static_torque.expand_as(share), share)
        sign = (state.qvel / self.smoothing_velocity).tanh_()
        return FrictionTerms(torque=torch.addcmul(dry * sign, self.viscous_coefficient, state.qvel))


class TorchConstraint(TorchFriction):
    """MuJoCo's own friction, and a network of parts that JAX does not have beside it."""

    dimensions = {"dry": "torque"}
    constraint = True

    def __init__(self, nv: int = 1) -> None:
        super().__init__(nv, DRY)
        torch.manual_seed(0)
        self.network = torch.nn.Sequential(
            *(torch.nn.Linear(3, 4), torch.nn.LayerNorm(4), torch.nn.GELU(), torch.nn.Linear(4, 1))
        )
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))  # a number that is no floating-point one

    def forward(self, state: DriveState) -> FrictionTerms:
        seen = torch.stack([state.qpos, state.qvel, state.ctrl], dim=-1)
        return FrictionTerms(torque=0.1 * self.network(seen)[..., 0], frictionloss=self.dry)
