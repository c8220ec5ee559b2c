"""The signals of a recording that the actuator law and the friction law need besides state and command."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators import Actuator
from frictionzoo.core.errors import BenchError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.logs.clean import EXTRAS
from frictionzoo.logs.pairing import Pairing, arrange, reorder, say_order

_log = logging.getLogger(__name__)


def pair_all(dataset: Dataset, joints: Sequence[str]) -> Dataset:
    """Return a data set whose logs have their columns in the order of the joints, and tell what is not plain of it.

    Raises:
        LogError: As `pair_log`.
    """
    lines = [line for log in dataset.logs for line in say_order(log.columns, _arrange(log, joints))]
    for line in dict.fromkeys(lines):
        _log.info("%s: %s", dataset.name, line)
    train, test = (tuple(pair_log(log, joints) for log in logs) for logs in (dataset.train, dataset.test))
    return Dataset(dataset.name, train, test)


def pair_log(log: Log, joints: Sequence[str]) -> Log:
    """Return a log with its columns in the order of the joints, each signal's by the names in its headers.

    Raises:
        LogError: Headers name some of the joints and not all, one twice, or others.
    """
    found = _arrange(log, joints)
    orders = {signal: list(order) for signal, (order, _) in found.items()}
    if "qpos" in orders:
        orders.setdefault("qvel", orders["qpos"])  # estimated, joint by joint
    values = {
        signal: getattr(log, signal)[:, orders[signal]] for signal in ("qpos", "qvel", "ctrl") if signal in orders
    }
    extras = {name: extra[:, orders[name]] if name in orders else extra for name, extra in log.extras.items()}
    return replace(log, **values, extras=extras, columns=reorder(log.columns, found))


def _arrange(log: Log, joints: Sequence[str]) -> dict[str, Pairing]:
    """The columns of each joint of the signals that a log has; a velocity that was estimated has none."""
    held = {"qpos", "ctrl", *log.extras, *(() if log.velocity_estimated else ("qvel",))}
    return arrange(log.name, {signal: of for signal, of in log.columns.items() if signal in held}, joints)


def pick_inputs(log: Log, actuator: Actuator, nv: int) -> dict[str, Float[np.ndarray, "time nv"]]:
    """What the actuator law of so many joints needs besides the command, by name.

    Raises:
        BenchError: The recording lacks one, or has another number of columns of it, or values that are not finite.
    """
    for name in actuator.inputs:
        if name not in log.extras and name not in actuator.optional_inputs:
            column = f"map a column (data.columns.{name}), or " if name in EXTRAS else ""
            raise BenchError(
                f"{log.name}: no {name}, which {type(actuator).__name__} needs; {column}give a field or a number "
                f"('data.inputs={{{name}: VALUE}}')"
            )
    return _pick(log, {name: actuator.optional_inputs.get(name, 0.0) for name in actuator.inputs}, nv)


def pick_observed(log: Log, observed: Mapping[str, float], nv: int) -> dict[str, Float[np.ndarray, "time nv"]]:
    """What the friction law looks at besides the state, as `Bench.observed` says, by name.

    Raises:
        BenchError: The recording has another number of columns of one, or values that are not finite.
    """
    return _pick(log, observed, nv)


def say_lacking(dataset: Dataset, wanted: Mapping[str, float], whose: str, otherwise: str = "") -> None:
    """Tell what no recording of a data set has, and is taken as the number beside its name.

    Args:
        dataset: The recordings.
        wanted: Signals by name.
        whose: The law that looks at them.
        otherwise: What else a user may do where some have one and others do not.

    Raises:
        BenchError: Some have one and others do not.
    """
    for name, value in wanted.items():
        having = [log.name for log in dataset.logs if name in log.extras]
        lacking = [log.name for log in dataset.logs if name not in log.extras]
        if having and lacking:
            raise BenchError(
                f"{lacking[0]}: no {name}, which {having[0]} has and the {whose} uses; map a column "
                f"(data.columns.{name}), leave out one of them{otherwise}"
            )
        if lacking:
            _log.info("%s: no %s recorded; the %s uses %g", dataset.name, name, whose, value)


def _pick(log: Log, wanted: Mapping[str, float], nv: int) -> dict[str, Float[np.ndarray, "time nv"]]:
    """Signals by name, each what the recording has of it, or else the number that it has here."""
    return {
        name: _for_each_joint(log, name, nv) if name in log.extras else np.full(log.qpos.shape, value)
        for name, value in wanted.items()
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
