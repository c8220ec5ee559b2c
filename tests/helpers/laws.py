"""Friction laws at given speeds."""

import torch

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models import FrictionModel


def friction(
    model: FrictionModel, qvel: list[float], motor: float = 0.0, external: float = 0.0, **values: float
) -> FrictionTerms:
    given = {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}
    speeds = torch.tensor(qvel, dtype=torch.float64)[:, None]
    zero, ones = torch.zeros_like(speeds), torch.ones_like(speeds)
    return model.terms(torch, given, DriveState(zero, speeds, zero, motor * ones, external * ones))
