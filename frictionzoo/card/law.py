"""What a card says of a friction law: its text, and its torque over velocity with a band."""

import copy
import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.card.types import LawRow
from frictionzoo.models import FrictionModel
from frictionzoo.result.curves import sample_friction
from frictionzoo.result.identified import Identified
from frictionzoo.show.text import to_markdown

DRAWS = 100  # drives within the intervals
STATES = 2000  # recorded ones at which their friction is looked at
_WITHIN = (0.025, 0.975)


def list_laws(drive: Identified) -> list[LawRow]:
    """The laws of the joints, each once."""
    rows: dict[str, LawRow] = {}
    for at, joint in enumerate(drive.bench.joints):
        law = drive.model.of_joint(at)[0]
        text = to_markdown(inspect.getdoc(type(law)) or "")
        rows.setdefault(law.name, {"name": law.name, "joints": [], "text": text})["joints"].append(joint)
    return list(rows.values())


def trace_law(
    drive: Identified,
) -> tuple[Float[np.ndarray, "points"], tuple[Float[np.ndarray, "points nv"], ...]]:
    """Friction torque over the velocities of the held-out rollouts, and lower and upper end of its band.

    The band holds 80 % of the recorded states at about each velocity, for 95 % of the drives that the intervals allow.

    Args:
        drive: With its recordings.

    Returns:
        Velocities, and the three curves, NaN where a joint was never as fast.
    """
    every = max(1, len(drive.samples.qvel) // STATES)
    states = drive.samples.map(lambda signal: signal[::every])
    velocity, torque, low, high = sample_friction(drive.model, states)
    drawn = drive.sample(DRAWS) if drive.result["covariance"] else {}
    visited = np.abs(velocity)[:, None] <= np.abs(states.qvel).max(axis=0)
    torque = np.where(visited, torque, np.nan)
    if not any(name.startswith("friction.") for name in drawn):
        return velocity, (torque, low, high)
    ends = [
        sample_friction(_with(drive.model, drive.with_values({n: v[at] for n, v in drawn.items()})["friction"]), states)
        for at in range(DRAWS)
    ]
    low, high = (np.quantile([end[side] for end in ends], q, axis=0) for side, q in zip((2, 3), _WITHIN, strict=True))
    return velocity, (torque, np.minimum(low, torque), np.maximum(high, torque))


def _with(model: FrictionModel, values: Mapping[str, Any]) -> FrictionModel:
    other = copy.deepcopy(model)
    other.load_state_dict({name: torch.as_tensor(np.array(value, np.float64)) for name, value in values.items()})
    return other
