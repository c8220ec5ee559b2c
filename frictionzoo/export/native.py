"""Bristle friction models native to MuJoCo C: the `lugre` friction of a `dcmotor` with negligible motor constant."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.template import in_full
from frictionzoo.core.errors import ExportError
from frictionzoo.core.xml import write_xml
from frictionzoo.export.simulate import run_loaded
from frictionzoo.export.skeleton import find_free_name
from frictionzoo.result.fitted_drive import FittedDrive

LAWS = ("lugre", "dahl")
REASON = "MuJoCo takes the bristles' torque at a step's beginning, the drive at its end"
_NO_WINDING = {"motorconst": "1e-9", "resistance": "1", "input": "none"}  # back-EMF of 1e-18 N m s/rad, no command


def write_native(fitted: FittedDrive) -> str:
    """Write the bench's MJCF with MuJoCo's damping, and for each joint a `dcmotor` with the friction model as `lugre`.

    Both have the same equations, and integrate the deflection exactly for a constant velocity within a step.

    Source: see the friction model; MuJoCo documentation, XML reference, `actuator/dcmotor`.

    Raises:
        ExportError: MuJoCo has no such friction model.
    """
    model, bench = fitted.model, fitted.bench
    if model.name not in LAWS:
        raise ExportError(f"law=native: MuJoCo has no {model.name}, expected {' or '.join(LAWS)}; leave law out")
    values = fitted.values["friction"]
    by_joint = {name: values[name][param.members(bench.nv)] for name, param in model.params.items()}
    remark = f"{model.name}: by MuJoCo's dcmotor, whose act is the bend of the bristles, and damping. {REASON}."
    root = ET.fromstring(
        bench.mjcf(fitted.values["bench"], None, by_joint["viscous_coefficient"], (remark,), limited=True)
    )
    section = root.find("actuator")
    assert section is not None
    taken = set(bench.joints)
    for joint, name in enumerate(bench.joints):
        numbers = " ".join(map(in_full, _lugre(by_joint, joint)))
        actuator = find_free_name(f"{name}_friction", taken)
        ET.SubElement(section, "dcmotor", {"name": actuator, "joint": name, **_NO_WINDING, "lugre": numbers})
    return write_xml(root)


def _lugre(values: Mapping[str, Float[np.ndarray, "nv"]], joint: int) -> list[float]:
    """Return bristle stiffness and damping, kinetic and static torque (equal for `dahl`), and Stribeck velocity."""
    torques = [name if name in values else "coulomb_torque" for name in ("kinetic_torque", "static_torque")]
    numbers = [values[name][joint] if name in values else 0.0 for name in ("stiffness", "micro_damping", *torques)]
    return [*map(float, numbers), float(values["stribeck_velocity"][joint]) if "stribeck_velocity" in values else 1.0]


def run_native(text: str, fitted: FittedDrive) -> Float[np.ndarray, "batch time nv"]:
    """Simulate the long test rollouts in MuJoCo C from the friction model's initial deflection; return positions."""
    segments, bench = fitted.segments, fitted.bench
    initial = fitted.samples.map(lambda signal: signal.reshape(segments.count, segments.length, bench.nv)[:, 0])
    deflection = fitted.model.settle(np, fitted.values["friction"], initial)[..., 0]

    def begin(data: mujoco.MjData, rollout: int) -> None:
        data.act[:] = deflection[rollout]

    return run_loaded(mujoco.MjModel.from_xml_string(text), fitted, begin=begin)
