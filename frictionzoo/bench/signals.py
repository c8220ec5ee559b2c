"""The signals of a recording that the actuator law and the friction law need besides state and command."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators import Actuator
from frictionzoo.core.errors import BenchError
from frictionzoo.core.log import Log
from frictionzoo.logs.clean import EXTRAS


def pick_inputs(log: Log, actuator: Actuator, nv: int) -> dict[str, Float[np.ndarray, "time nv"]]:
    """What the actuator law of so many joints needs besides the command, by name.

    Raises:
        BenchError: The recording lacks one, or has another number of columns of it, or values that are not finite.
    """
    for name in actuator.inputs:
        if name not in log.extras:
            column = f"map a column (data.columns.{name}), or " if name in EXTRAS else ""
            raise BenchError(
                f"{log.name}: no {name}, which {type(actuator).__name__} needs; {column}give a field or a number "
                f"('data.inputs={{{name}: VALUE}}')"
            )
    return {name: _for_each_joint(log, name, nv) for name in actuator.inputs}


def pick_observed(log: Log, observed: Mapping[str, float], nv: int) -> dict[str, Float[np.ndarray, "time nv"]]:
    """What the friction law looks at besides the state, as `Bench.observed` says, by name.

    Raises:
        BenchError: The recording has another number of columns of one, or values that are not finite.
    """
    return {
        name: _for_each_joint(log, name, nv) if name in log.extras else np.full(log.qpos.shape, value)
        for name, value in observed.items()
    }


def _for_each_joint(log: Log, name: str, nv: int) -> Float[np.ndarray, "time nv"]:
    signal = log.extras[name]
    if signal.shape[1] not in (1, nv):
        raise BenchError(
            f"{log.name}: {name} has {signal.shape[1]} columns, expected 1 for all joints or {nv}, one a "
            f"joint; choose other columns (data.columns.{name})"
        )
    if not np.isfinite(signal).all():
        raise BenchError(
            f"{log.name}: {name} is NaN or infinite in {(~np.isfinite(signal)).any(axis=1).sum()} of {len(signal)} "
            "samples, expected finite values; cut or repair the log"
        )
    return np.broadcast_to(signal, log.qpos.shape)
