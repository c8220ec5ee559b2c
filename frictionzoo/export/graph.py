"""A friction law as a function of plain tensors, which runtimes without frictionzoo can hold."""

import copy
from collections.abc import Mapping

import numpy as np
import torch

from frictionzoo.core.errors import ConfigError, closest
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.export.base import measure
from frictionzoo.export.nearest import evaluate_law
from frictionzoo.export.written import Difference
from frictionzoo.models.base import FrictionModel, sliding_torque
from frictionzoo.result.identified import Identified

DTYPES = {"float64": torch.float64, "float32": torch.float32}
LIMITS = (
    "The friction law only: armature, actuator and delay stay with the simulator. Inputs qpos, qvel, ctrl, "
    "motor_torque and external_torque of shape (batch, nv) are one instant, in SI units; no history.",
    "Outputs torque, frictionloss and damping of shape (batch, nv). Subtract torque + damping * qvel from the drive's "
    "torque; dry friction is whatever stops the joint, at most frictionloss. What the law does not use is 0.",
)
_OBSERVED = "Besides, the inputs {names} of the same shape: the friction law looks at them too."


class Graph(torch.nn.Module):
    """A law with its values as constants: the signals of a `DriveState` to the three of `FrictionTerms`.

    Args:
        model: The law; it is copied.
        dtype: Of inputs, outputs and constants.
    """

    def __init__(self, model: FrictionModel, dtype: torch.dtype) -> None:
        super().__init__()
        self.law: FrictionModel = copy.deepcopy(model).to(dtype).requires_grad_(False)
        self.eval()

    def forward(
        self,
        qpos: torch.Tensor,
        qvel: torch.Tensor,
        ctrl: torch.Tensor,
        motor_torque: torch.Tensor,
        external_torque: torch.Tensor,
        temperature: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, ...]:
        """Each of the terms, of shape (batch, nv), 0 where the law does not use it."""
        terms = self.law(DriveState(qpos, qvel, ctrl, motor_torque, external_torque, temperature))
        shape = qvel.shape
        return tuple(torch.zeros_like(qvel) if term is None else torch.broadcast_to(term, shape) for term in terms)


def signals(model: FrictionModel) -> tuple[str, ...]:
    """Names of what a law looks at, in order."""
    return tuple(name for name in DriveState._fields if name in model.inputs or name not in DriveState._field_defaults)


def limits(model: FrictionModel) -> tuple[str, ...]:
    """What a user of the law alone has to know."""
    return (*LIMITS, _OBSERVED.format(names=", ".join(model.inputs))) if model.inputs else LIMITS


def example(model: FrictionModel, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    """Inputs to record a graph with: two rows, since one would be taken for a constant."""
    return tuple(torch.ones(2, model.nv, dtype=dtype) for _ in signals(model))


def inputs(samples: DriveState, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    """The samples by name."""
    return samples.map(lambda signal: torch.tensor(np.asarray(signal, np.float64), dtype=dtype)).given()


def compare(fitted: Identified, came: FrictionTerms, how: str) -> Difference:
    """How far answers at the recorded states are from the law in float64, in friction torque while the joint moves.

    Args:
        fitted: The drive.
        came: Arrays of shape (samples, nv).
        how: By what they were computed.
    """
    samples = fitted.samples
    expected = sliding_torque(np, evaluate_law(fitted.model, samples), samples.qvel)
    over = f"{len(expected)} recorded states in {how}"
    return measure("torque", fitted, sliding_torque(np, came, samples.qvel), expected, over)


def read_dtype(options: Mapping[str, str]) -> str:
    """The option `dtype`; float64 where it was not given.

    Raises:
        ConfigError: Another one.
    """
    dtype = options.get("dtype", "float64")
    if dtype not in DTYPES:
        raise ConfigError(f"dtype={dtype}: unknown; {closest(dtype, DTYPES)}")
    return dtype
