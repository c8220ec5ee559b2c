"""Signals of a recording that actuator law and friction model need in addition to state and command."""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators import Actuator
from frictionzoo.core.errors import BenchError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.data.clean import EXTRAS
from frictionzoo.data.pairing import Pairing, arrange, in_order, lay_out, reorder, say_order

_log = logging.getLogger(__name__)


def pair_all(dataset: Dataset, joints: Sequence[str], passive: Collection[str] = ()) -> Dataset:
    """Return a data set with columns in the order of the joints, and log each reordering.

    Raises:
        LogError: See `pair_log`.
    """
    lines = [line for log in dataset.logs for line in say_order(log.columns, _arrange(log, joints, passive))]
    for line in dict.fromkeys(lines):
        _log.info("%s: %s", dataset.name, line)
    train, test = (tuple(pair_log(log, joints, passive) for log in logs) for logs in (dataset.train, dataset.test))
    return Dataset(dataset.name, train, test)


def pair_log(log: Log, joints: Sequence[str], passive: Collection[str] = ()) -> Log:
    """Return a log with columns in the order of the joints, by the names in each signal's headers.

    Commands that the `passive` joints lack become 0.

    Raises:
        LogError: Headers name only some of the joints, a joint twice, or unknown joints.
    """
    pairings = _arrange(log, joints, passive)
    orders = {signal: order for signal, (order, _) in pairings.items()}
    if "qpos" in orders:
        orders.setdefault("qvel", orders["qpos"])  # estimated from qpos
    for signal in [name for name in ("ctrl", *log.extras) if name not in log.columns]:
        count = (log.ctrl if signal == "ctrl" else log.extras[signal]).shape[1]
        orders |= {} if (order := lay_out(signal, range(count), joints, passive)) is None else {signal: order}
    paired = [signal for signal in ("qpos", "qvel", "ctrl") if signal in orders]
    values = {signal: in_order(getattr(log, signal), orders[signal]) for signal in paired}
    extras = {name: in_order(extra, orders[name]) if name in orders else extra for name, extra in log.extras.items()}
    return replace(log, **values, extras=extras, columns=reorder(log.columns, pairings))


def _arrange(log: Log, joints: Sequence[str], passive: Collection[str]) -> dict[str, Pairing]:
    """Return the pairing of each recorded signal's columns with the joints; an estimated velocity has none."""
    recorded = {"qpos", "ctrl", *log.extras, *(() if log.velocity_estimated else ("qvel",))}
    columns = {signal: headers for signal, headers in log.columns.items() if signal in recorded}
    return arrange(log.name, columns, joints, passive)


def refuse_columns(log: Log, joints: Sequence[str], source: str) -> None:
    """Refuse a log whose positions or commands have another number of columns than the file `source` has joints.

    Raises:
        BenchError: The number differs.
    """
    for signal in ("qpos", "ctrl"):
        columns = getattr(log, signal).shape[1]
        if columns != len(joints):
            raise BenchError(
                f"{log.name}: {signal} has {columns} columns, expected {len(joints)} for the joints "
                f"{', '.join(joints)} of {source}; choose other columns or another bench.joint"
            )


def add_inputs(log: Log, actuator: Actuator, observed: Mapping[str, float], values: Mapping[str, np.ndarray]) -> Log:
    """Return the log with the inputs of the actuator law and those of the friction model, `observed`.

    A velocity servo's command is the recorded desired velocity if there is one, and `ctrl` otherwise. `values` are the
    bench's parameters.

    Raises:
        BenchError: An input is missing, has a wrong number of columns, or is not finite.
    """
    nv = log.qpos.shape[1]
    log = replace(log, inputs=pick_inputs(log, actuator, nv), observed=pick_signals(log, observed, nv))
    servos = (values["kp"] == 0) & (values["kd"] > 0) if {"kp", "kd"} <= values.keys() else np.zeros(nv, bool)
    velocity = log.inputs.get("ctrl_velocity")
    if velocity is None or "ctrl_velocity" not in log.extras or not servos.any():
        return log
    inputs = {**log.inputs, "ctrl_velocity": np.where(servos, 0.0, velocity)}
    return replace(log, ctrl=np.where(servos, velocity, log.ctrl), inputs=inputs)


def pick_inputs(log: Log, actuator: Actuator, nv: int) -> dict[str, Float[np.ndarray, "time nv"]]:
    """Return the inputs of the actuator law of `nv` joints, by name.

    Raises:
        BenchError: An input is missing, has a wrong number of columns, or is not finite.
    """
    for name in actuator.inputs:
        if name not in log.extras and name not in actuator.optional_inputs:
            column = f"map a column (data.columns.{name}), or " if name in EXTRAS else ""
            raise BenchError(
                f"{log.name}: no {name}, which {type(actuator).__name__} needs; {column}give a field or a number "
                f"('data.inputs={{{name}: VALUE}}')"
            )
    return pick_signals(log, {name: actuator.optional_inputs.get(name, 0.0) for name in actuator.inputs}, nv)


def say_lacking(dataset: Dataset, wanted: Mapping[str, float], whose: str, otherwise: str = "") -> None:
    """Log each signal in `wanted` that no recording contains, the model that uses it, and its replacement value.

    Raises:
        BenchError: Only some recordings contain a signal; `otherwise` adds advice.
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


def pick_signals(log: Log, wanted: Mapping[str, float], nv: int) -> dict[str, Float[np.ndarray, "time nv"]]:
    """Return signals for `nv` joints by name: the recorded signal, or else the constant in `wanted`.

    Raises:
        BenchError: A signal has a wrong number of columns, or is not finite.
    """
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
