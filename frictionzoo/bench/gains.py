"""Missing controller gains, from recorded gain columns or by regression of the recorded torque."""

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, MissingValueError
from frictionzoo.core.log import Dataset, Log

GAINS = {"kp": "15", "kd": "0.5"}  # with examples of values
_OPTION = "actuator.params.{}.init"
_CONSTANT = 1e-6  # relative variation up to which a gain is constant
_EXPLAINED = 0.95  # least share of the recorded torque's variance that the gains must explain
_KNOWN = 0.1  # largest relative standard error of kp
_LATEST, _LAGS = 0.1, 50  # longest delay of a command [s], and approximate number of tested lags
_CORRELATED = 15.0  # correlation length of the residual [samples]
_LEAST = 1e-3  # least kd, as a share of kp times 1 s
_log = logging.getLogger(__name__)


class _Regression(NamedTuple):
    """Gains of a joint, their explained share of the torque's variance, and the relative standard error of kp."""

    kp: float
    kd: float
    explained: float
    error: float


def list_missing(section: Mapping[str, Any]) -> list[str]:
    """Return the names of the gains whose `init` in a bench's section is null."""
    params = section.get("actuator", {}).get("params") or {}
    return [name for name in GAINS if isinstance(params.get(name), Mapping) and params[name].get("init", 0) is None]


def find_gains(section: Mapping[str, Any], dataset: Dataset, missing: MissingValueError) -> dict[str, Any]:
    """Return the missing gains by name, one value or a list with one per joint, and log their origin.

    Raises:
        ConfigError: A recorded gain varies, or the recordings do not determine a gain.
        MissingValueError: `missing`, the error of building the bench, if the missing value is not a gain.
    """
    wanted = list_missing(section)
    if not wanted:
        raise missing
    gains, reason = _read_columns(wanted, dataset), ""
    if len(gains) < len(wanted):
        regressed, reason = _regress(dataset.train)
        gains = regressed | gains
    gains = _start_identified(section, [name for name in wanted if name not in gains]) | gains
    if unresolved := [name for name in wanted if name not in gains]:
        options = " ".join(f"bench.{_OPTION.format(name)}={GAINS[name]}" for name in unresolved)
        columns = " and ".join(f"data.columns.{name}" for name in unresolved)
        raise ConfigError(
            f"{' and '.join(unresolved)} of the controller: no value{reason}; give your controller's values, as in "
            f"{options}, or map the columns that contain them ({columns}) or the joint's torque (data.columns.torque), "
            "from which they are computed"
        )
    return {name: gains[name] if len(gains[name]) > 1 else gains[name][0] for name in wanted}


def _start_identified(section: Mapping[str, Any], names: Sequence[str]) -> dict[str, list[float]]:
    """Return the geometric mean of the bounds for gains that are identified, and need only a start."""
    gains: dict[str, list[float]] = {}
    for name in names:
        param = section["actuator"]["params"][name]
        low, high = param.get("low"), param.get("high")
        if param.get("identify") is True and isinstance(low, int | float) and isinstance(high, int | float) and low > 0:
            gains[name] = [float(f"{math.sqrt(low * high):.4g}")]
            _tell(name, gains[name], "the middle of its bounds, where its identification starts")
    return gains


def _read_columns(wanted: Sequence[str], dataset: Dataset) -> dict[str, list[float]]:
    """Return gains that all recordings contain as constant columns, one value per joint."""
    gains: dict[str, list[float]] = {}
    for name in wanted:
        if not all(name in log.extras for log in dataset.logs):
            continue
        values = np.concatenate([log.extras[name] for log in dataset.logs])
        if (np.ptp(values, axis=0) > _CONSTANT * np.abs(values).max(axis=0)).any():
            leave_out = " ".join(f"~bench.actuator.params.{gain}" for gain in wanted)
            raise ConfigError(
                f"{name} varies in the recordings, from {values.min():.4g} to {values.max():.4g}, expected one value a "
                f"joint; take the recorded gains: bench.actuator._target_=frictionzoo.bench.RecordedPD {leave_out}"
            )
        gains[name] = values[0].tolist()
        _tell(name, gains[name], "as recorded")
    return gains


def _regress(logs: Sequence[Log]) -> tuple[dict[str, list[float]], str]:
    """Return gains by regression of the recorded torque, one value per joint, or the reason for their absence."""
    if not all("torque" in log.extras and log.extras["torque"].shape == log.qpos.shape for log in logs):
        return {}, ""
    rows = [_regress_joint(logs, joint) for joint in range(logs[0].qpos.shape[1])]
    worst = min(rows, key=lambda row: row.explained)
    if worst.explained < _EXPLAINED:
        share = f"{100 * max(worst.explained, 0):.0f} % explained, expected {100 * _EXPLAINED:.0f} %"
        return {}, f", and the recorded torque is not kp (ctrl - qpos) - kd qvel ({share})"
    if any(row.error > _KNOWN or row.kp <= 0 for row in rows):
        return {}, ", and the motion contains too little information to separate kp from kd"
    gains = {
        "kp": [float(f"{row.kp:.4g}") for row in rows],
        "kd": [float(f"{max(row.kd, _LEAST * row.kp):.4g}") for row in rows],
    }
    for name, values in gains.items():
        share = f"{100 * worst.explained:.1f} % of its variance"
        _tell(name, values, f"from the recorded torque; both gains explain {share}")
    return gains, ""


def _regress_joint(logs: Sequence[Log], joint: int) -> _Regression:
    """Return the regression with the best lag of the command."""
    step = max(1, round(_LATEST / logs[0].timestep / _LAGS))
    lags = range(0, round(_LATEST / logs[0].timestep) + 1, step)
    fits = (_solve(*_equations(logs, joint, lag)) for lag in lags if all(log.samples > lag + 100 for log in logs))
    return max(fits, key=lambda row: row.explained, default=_Regression(0.0, 0.0, 0.0, np.inf))


def _equations(
    logs: Sequence[Log], joint: int, lag: int
) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows"]]:
    """Return columns and torques of torque = kp (ctrl - qpos) + kd (ctrl_velocity - qvel) + ctrl_torque + offset."""
    columns, torques = [], []
    for log in logs:
        zeros = np.zeros_like(log.qpos)
        velocity, feedforward = (
            np.broadcast_to(log.extras.get(n, zeros), zeros.shape) for n in ("ctrl_velocity", "ctrl_torque")
        )
        end = log.samples - lag
        error, rate = log.ctrl[:end] - log.qpos[lag:], velocity[:end] - log.qvel[lag:]
        columns.append(np.column_stack([error[:, joint], rate[:, joint], np.ones(end)]))
        torques.append(log.extras["torque"][lag:, joint] - feedforward[:end, joint])
    return np.concatenate(columns), np.concatenate(torques)


def _solve(columns: Float[np.ndarray, "rows 3"], torque: Float[np.ndarray, "rows"]) -> _Regression:
    size = np.maximum(np.abs(columns).max(axis=0), 1e-300)
    values = np.linalg.lstsq(columns / size, torque, rcond=None)[0]
    residual, variance = torque - columns / size @ values, max(float(np.var(torque)), 1e-300)
    covariance = _CORRELATED * np.var(residual) * np.linalg.pinv((columns / size).T @ (columns / size))
    error = float(np.sqrt(covariance[0, 0]) / max(abs(values[0]), 1e-300))
    kp, kd, _ = (values / size).tolist()
    return _Regression(kp, kd, float(1 - np.var(residual) / variance), error)


def _tell(name: str, values: Sequence[float], why: str) -> None:
    text = values[0] if len(values) == 1 else f"[{','.join(f'{value:g}' for value in values)}]"
    _log.info("bench.%s=%s: %s", _OPTION.format(name), text, why)
