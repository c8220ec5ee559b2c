"""Recorded torque against what an identified drive needs for the recorded motion: what is left, joint by joint."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.bench.actuators.force import Force
from frictionzoo.core.errors import ConfigError, FrictionzooError, closest
from frictionzoo.core.params import UNITS
from frictionzoo.fit import Fit, Space
from frictionzoo.fit.motion import Filtering
from frictionzoo.fit.recordings import Recordings
from frictionzoo.fit.torque_equation import TorqueEquation
from frictionzoo.models import TorchFriction
from frictionzoo.result import torque_types as types

AS_THE_FIT: Mapping[str, Any] = {"bandwidth": None, "held": None}
"""Torque is compared as the fit does it."""
_log = logging.getLogger(__name__)


def choose_filtering(fit: Fit, torque: Mapping[str, Any]) -> tuple[Filtering, bool]:
    """How torque is compared, and whether a command is held: as the fit has it, but for what the options say.

    Args:
        fit: The method.
        torque: `evaluation.torque`: `bandwidth` [Hz] and `held`, None for the fit's.

    Raises:
        ConfigError: An option is unknown or impossible.
    """
    for name in torque.keys() - AS_THE_FIT.keys():
        raise ConfigError(f"evaluation.torque.{name}: unknown; {closest(name, AS_THE_FIT)}")
    given = {**AS_THE_FIT, **torque}
    held = fit.held if given["held"] is None else bool(given["held"])
    if given["bandwidth"] is None:
        return replace(fit.filtering, option="evaluation.torque"), held
    return Filtering(float(given["bandwidth"]), option="evaluation.torque"), held


def measure_torque(
    recordings: Recordings,
    train: int,
    space: Space,
    vector: Float[np.ndarray, "coordinates"],
    filtering: tuple[Filtering, bool],
) -> types.TorqueRow | None:
    """Root mean squares of the torque that is left of each joint, as `TorqueRow` says what that is.

    Args:
        recordings: Bench, law, and all logs, those of the training first.
        train: How many these are.
        space: Coordinates of the values.
        vector: The values.
        filtering: As `choose_filtering` gives it.

    Returns:
        None where the recordings have no torque or it cannot be compared; a line tells why.
    """
    compared = _find_torque(recordings)
    if compared is None:
        return None
    try:
        measured = compared == "torque"
        equation = TorqueEquation(space, recordings, *filtering, measured=measured)
        left, driving = equation.lack(vector), equation.driving(vector)
    except FrictionzooError as error:
        _log.info("residual torque not computed: %s", error)
        return None
    seen = int(np.cumsum(equation.rows)[train - 1])
    halves = [np.split(torque, [seen]) for torque in (left, driving)]
    found = {part: _rms(*torques) for part, torques in zip(("train", "test"), zip(*halves, strict=True), strict=True)}
    used, held = filtering
    how = {"compared": compared, "bandwidth": used.bandwidth, "held": held and not measured}
    return cast(types.TorqueRow, how | _describe(recordings.bench, found))


def _find_torque(recordings: Recordings) -> Literal["torque", "ctrl"] | None:
    """What of the recordings is torque: `torque`, `ctrl` or nothing."""
    bench, model, logs = recordings
    if isinstance(model, TorchFriction):
        _log.info("residual torque not computed: %s exists only in torch", model.name)
        return None
    recorded = [log.extras.get("torque") for log in logs]
    if all(torque is not None and torque.shape == log.qpos.shape for torque, log in zip(recorded, logs, strict=True)):
        return "torque"
    if any(torque is not None for torque in recorded):
        _log.warning("recorded torque is not compared: not every log has it for every joint")
    return "ctrl" if isinstance(bench.actuator, Force) else None


def _rms(*torques: Float[np.ndarray, "rows nv"]) -> Float[np.ndarray, "torques nv"]:
    return np.stack([np.sqrt(np.mean(np.square(torque), axis=0)) for torque in torques])


def _describe(bench: Bench, found: Mapping[str, Float[np.ndarray, "torques nv"]]) -> dict[str, Any]:
    """Root mean squares of each part, on average and joint by joint."""

    def row(of: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
        return {part: dict(zip(("residual", "torque"), of(rms).tolist(), strict=True)) for part, rms in found.items()}

    return {
        "unit": UNITS[bench.joint_type]["torque"],
        "mean": row(lambda rms: rms.mean(axis=1)),
        "by_joint": [{"joint": joint, **row(lambda rms, at=at: rms[:, at])} for at, joint in enumerate(bench.joints)],
    }
