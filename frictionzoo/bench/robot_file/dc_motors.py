"""Bristle friction, torque per volt and back-EMF of the `<dcmotor>`s in a robot's file.

Source: MuJoCo documentation, XML reference, `actuator/dcmotor`, and MuJoCo's compiler, which stores it in
`actuator_dynprm`, `actuator_gainprm` and `actuator_biasprm`.
"""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.robot_file.source import Source

_UNCONTROLLED = int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE) | int(mujoco.mjtCtrlInput.mjINPUT_NONE)
_STIFFNESS, _MICRO_DAMPING = 5, 6  # in dynprm
_KINETIC, _STATIC, _STRIBECK = 3, 4, 5  # in biasprm
BRISTLES = ("stiffness", "micro_damping", "kinetic_torque", "static_torque", "stribeck_velocity")


def is_dc_motor(model: mujoco.MjModel, index: int) -> bool:
    """Return whether an actuator is a `<dcmotor>` or an equivalent general actuator."""
    return int(model.actuator_dyntype[index]) == mujoco.mjtDyn.mjDYN_DCMOTOR


def why_not_linear(model: mujoco.MjModel, index: int) -> str | None:
    """Return the reason why a DC motor's torque without bristles is not linear in voltage and velocity, or None."""
    if int(model.actuator_ctrlspec[index]) & ~_UNCONTROLLED:
        return "its DC motor has a controller of its own"
    winding = np.delete(model.actuator_dynprm[index], (_STIFFNESS, _MICRO_DAMPING))
    if winding.any() or model.actuator_gainprm[index, 2:].any():
        return "its DC motor has a winding with inductance, heat or a limit of voltage"
    if model.actuator_biasprm[index, 0]:
        return "its DC motor has cogging"
    return None


def torque_per_volt(model: mujoco.MjModel, index: int) -> float:
    """Return the torque per volt of a DC motor, before its gear [N m/V or N/V]."""
    resistance, constant = model.actuator_gainprm[index, :2]
    return float(constant / resistance)


def read_back_emf(model: mujoco.MjModel, index: int) -> float:
    """Return the damping of the joint from a DC motor's back-EMF [N m s/rad or N s/m]."""
    return float(model.actuator_gear[index, 0] ** 2 * model.actuator_gainprm[index, 1]) * torque_per_volt(model, index)


def read_bristles(source: Source, motors: Mapping[int, Sequence[int]]) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the parameters of `lugre` from the DC motors' indices by joint, and note them; NaN without bristles."""
    model, rows, names = source.model, list[list[float]](), [source.name("joint", joint) for joint in motors]
    for name, indices in zip(names, motors.values(), strict=True):
        with_bristles = [index for index in indices if model.actuator_dynprm[index, _STIFFNESS] > 0]
        if len(with_bristles) > 1:
            source.note(f"joint {name} has {len(with_bristles)} DC motors with bristles; only the first is read")
        rows.append(_bristles(model, with_bristles[0]) if with_bristles else [np.nan] * len(BRISTLES))
    values: dict[str, np.ndarray] = dict(zip(BRISTLES, np.array(rows).T, strict=True))
    is_dahl = (values["micro_damping"] == 0) & (values["static_torque"] == values["kinetic_torque"])
    for law, matches in {"dahl": is_dahl, "lugre": ~is_dahl & ~np.isnan(values["stiffness"])}.items():
        joints = [name for name, match in zip(names, matches, strict=True) if match]
        source.note(f"bristles of <dcmotor> at joint {{}}: left out, model={law} begins with them", joints)
    return values


def _bristles(model: mujoco.MjModel, index: int) -> list[float]:
    """Return a DC motor's bristle parameters reflected through the gear, in the order of `BRISTLES`."""
    gear = abs(float(model.actuator_gear[index, 0]))
    dynamics, bias = model.actuator_dynprm[index], model.actuator_biasprm[index]
    static = bias[_STATIC] if bias[_STRIBECK] > 0 else bias[_KINETIC]  # without a Stribeck velocity MuJoCo ignores it
    springs = gear**2 * dynamics[[_STIFFNESS, _MICRO_DAMPING]]
    return [float(number) for number in (*springs, gear * bias[_KINETIC], gear * static, bias[_STRIBECK] / gear)]
