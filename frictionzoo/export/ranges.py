"""Limits of a robot's actuator, converted for the identified actuator that replaces it."""

from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.robot_file.actuators import ReadActuator, read_actuators
from frictionzoo.bench.robot_file.source import Source
from frictionzoo.bench.template import in_full

_AT_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_NONE = np.array([np.nan, np.nan])


def list_limits(before: Source, joint: str, law: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """Return group and ranges of a joint's actuator as attributes of an actuator without class and gear, and remarks.

    The command range stays, in the unit of the new actuator, if both actuators take positions or both take torques. If
    a position controller replaces a motor, the motor's command range limits the force. `law` has the new `gainprm` and
    `biasprm`.
    """
    model, index = before.model, before.model.joint(joint).id
    of_joint = np.isin(model.actuator_trntype, _AT_JOINT) & (model.actuator_trnid[:, 0] == index)
    if not of_joint.any():
        return _as_attributes(_NONE, _NONE, 0), []
    group = int(model.actuator_group[of_joint][0])
    (read,) = read_actuators(before, [index])
    if read is None:
        return _as_attributes(_NONE, _NONE, group), [f"The limits of the actuator that joint {joint} had are left out."]
    ctrl, force, notes = _convert(read, float(law["gainprm"]), *map(float, law["biasprm"].split()[1:]))
    return _as_attributes(ctrl, force, group), notes


def _convert(read: ReadActuator, gain: float, bias1: float, bias2: float) -> tuple[np.ndarray, np.ndarray, list[str]]:
    ctrl, force = np.array(read.ctrlrange), np.array(read.forcerange)
    if read.bias1 and bias1:
        return _ordered(ctrl * (read.gain / read.bias1) * (bias1 / gain)), force, []
    if read.kind == "motor" and not (bias1 or bias2):
        return _ordered(ctrl * (read.gain / gain)), force, []
    if not np.isfinite(ctrl).all():
        return _NONE, force, []
    if read.kind != "motor":
        return _NONE, force, ["Ranges of commands are left out: the identified actuators' commands are others."]
    low, high = _ordered(ctrl * read.gain)
    force = np.array([np.fmax(force[0], low), np.fmin(force[1], high)])
    return _NONE, force, ["The motors' ranges of commands limit the force: what is commanded now is no torque."]


def _ordered(ends: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    return np.sort(ends) if np.isfinite(ends).all() else ends


def _as_attributes(ctrl: Float[np.ndarray, "2"], force: Float[np.ndarray, "2"], group: int) -> dict[str, str]:
    """Write all limits explicitly, to override the robot's defaults."""
    attributes = {"group": str(group)} if group else {}
    for name, ends in (("ctrl", ctrl), ("force", force)):
        limited = bool(np.isfinite(ends).all())
        attributes[f"{name}limited"] = str(limited).lower()
        if limited:
            attributes[f"{name}range"] = " ".join(map(in_full, ends))
    return attributes
