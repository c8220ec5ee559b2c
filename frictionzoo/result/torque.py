"""Residual torque of each joint: recorded torque minus the torque that the drive needs for the recorded motion."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from operator import itemgetter
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.actuators.force import Force
from frictionzoo.core.errors import ConfigError, FrictionzooError, closest
from frictionzoo.core.units import UNITS
from frictionzoo.fit import Fit, Space
from frictionzoo.fit.motion import Filtering, Recordings
from frictionzoo.fit.torque_equation import TorqueEquation
from frictionzoo.models import TorchFriction
from frictionzoo.result import section_types as types

AS_THE_FIT: Mapping[str, Any] = {"bandwidth": None, "held": None}
"""Options that compare torque as the fit does."""
_log = logging.getLogger(__name__)


def choose_filtering(fit: Fit, torque: Mapping[str, Any]) -> tuple[Filtering, bool]:
    """Return the filtering of compared torque, and whether commands are held.

    Options of `torque` (`evaluation.torque`: `bandwidth` [Hz], `held`) override the fit's; None: as in the fit.

    Raises:
        ConfigError: An option is unknown or invalid.
    """
    for name in torque.keys() - AS_THE_FIT.keys():
        raise ConfigError(f"evaluation.torque.{name}: unknown; {closest(name, AS_THE_FIT)}")
    options = {**AS_THE_FIT, **torque}
    held = fit.held if options["held"] is None else bool(options["held"])
    if options["bandwidth"] is None:
        return replace(fit.filtering, option="evaluation.torque"), held
    return Filtering(float(options["bandwidth"]), option="evaluation.torque"), held


def measure_torque(
    recordings: Recordings,
    train: int,
    space: Space,
    vector: Float[np.ndarray, "coordinates"],
    filtering: tuple[Filtering, bool],
) -> types.Torque | None:
    """Compute the section `torque`: the root mean square residual torque of each joint, as defined in `Torque`.

    `recordings` has all logs, with the `train` training logs first; `filtering` comes from `choose_filtering`. None:
    the recordings have no torque, or it cannot be compared and a log line gives the reason.
    """
    compared = _find_torque(recordings)
    if compared is None:
        return None
    try:
        measured = compared == "torque"
        equation = TorqueEquation(space, recordings, *filtering, measured=measured)
        residual, driving = equation.lack(vector), equation.driving(vector)
    except FrictionzooError as error:
        _log.info("residual torque not computed: %s", error)
        return None
    training_rows = int(np.cumsum(equation.decimate.rows)[train - 1])
    parts = slice(training_rows), slice(training_rows, None)
    unit: Any = UNITS[recordings.bench.joint_type]["torque"]

    def measure(part: slice, of: Callable[[np.ndarray], Any]) -> types.TorqueErrors:
        by_joint = (np.sqrt(np.mean(np.square(torque[part]), axis=0)) for torque in (residual, driving))
        return types.TorqueErrors(*(float(of(each)) for each in by_joint))

    return types.Torque(
        compared=compared,
        unit=unit,
        bandwidth=filtering[0].bandwidth,
        held=filtering[1] and not measured,
        mean=types.TorqueParts(*(measure(part, np.mean) for part in parts)),
        by_joint=[
            types.JointTorque(joint, *(measure(part, itemgetter(index)) for part in parts))
            for index, joint in enumerate(recordings.bench.joints)
        ],
    )


def _find_torque(recordings: Recordings) -> Literal["torque", "ctrl"] | None:
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
