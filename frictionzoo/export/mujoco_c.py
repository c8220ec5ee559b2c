"""Target `mujoco`: a Python module with the friction model inside MuJoCo's step."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.bench.template import in_full
from frictionzoo.core.errors import ExportError
from frictionzoo.core.state import Signals
from frictionzoo.core.templates import Code
from frictionzoo.core.xml import write_xml
from frictionzoo.export.base import Export, Target, measure, read_choice, register_target
from frictionzoo.export.bench import say_limits
from frictionzoo.export.module import BENCH, MODULE, controls, load_module, write_drive
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.simulate import PAYLOADS, commands_before, run_loaded, simulate
from frictionzoo.export.skeleton import find_free_name
from frictionzoo.result.fitted_drive import FittedDrive

FORMS = ("module", "native")
LAWS = ("lugre", "dahl")  # friction models of MuJoCo's dcmotor
REASON = "MuJoCo uses the bristle torque at a step's beginning, the drive implicitly"
_LUGRE = ("stiffness", "micro_damping", "kinetic_torque", "static_torque", "stribeck_velocity")
_NO_WINDING = {"motorconst": "1e-9", "resistance": "1", "input": "none"}  # back-EMF of 1e-18 N m s/rad, no command


@register_target("mujoco")
class MujocoC(Target):
    """Python module with the exact friction model inside MuJoCo C's step; needs only numpy and mujoco."""

    options: ClassVar[Mapping[str, str]] = {
        "law": "module, its own formula in Python, or native, MuJoCo's dcmotor for lugre and dahl"
    }
    packages: ClassVar[tuple[str, ...]] = ("mujoco", "numpy")

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        if read_choice(options, "law", FORMS) == "native":
            return _write_native(fitted, folder)
        command = Code("drive.command[:] = ..." if controls(fitted) else "data.ctrl[...] = ...")
        written = write_drive(fitted, folder, "mujoco_drive.py.jinja", example_install=command)
        difference = measure("qpos", fitted, _run(folder, fitted), fitted.rollout()[0])
        limit = "It runs as MuJoCo's control callback, in Python, which makes steps slower."
        return Export(written, (difference,), (limit, *([PAYLOADS] if fitted.bench.payload is not None else [])))


def _write_native(fitted: FittedDrive, folder: Path) -> Export:
    text = write_native(fitted)
    (folder / BENCH).write_text(text)
    difference = measure("qpos", fitted, run_native(text, fitted), fitted.rollout()[0], reason=REASON)
    exact = Nearest.frictionless(fitted)
    limits = (
        f"{REASON}: the equations are the same, and the motions agree for short steps; stiff bristles need shorter "
        "steps than the drive.",
        "`act` of the dcmotor is the bristle deflection: 0 is a joint without load; the comparison begins with the "
        "drive's deflection.",
    )
    return Export((BENCH,), (difference,), (*limits, *say_limits(fitted, exact)))


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
    viscous = fitted.values["friction"]["viscous_coefficient"][model.params["viscous_coefficient"].members(bench.nv)]
    remark = f"{model.name}: by MuJoCo's dcmotor, whose act is the bend of the bristles, and damping. {REASON}."
    root = ET.fromstring(bench.mjcf(fitted.values["bench"], None, viscous, (remark,), limited=True))
    section = root.find("actuator")
    assert section is not None
    taken = set(bench.joints)
    for name, bristles in zip(bench.joints, list_bristles(fitted), strict=True):
        actuator = find_free_name(f"{name}_friction", taken)
        ET.SubElement(section, "dcmotor", {"name": actuator, "joint": name, **_NO_WINDING, "lugre": in_full(bristles)})
    return write_xml(root)


def list_bristles(fitted: FittedDrive) -> list[list[float]]:
    """Return the numbers of a dcmotor's `lugre` for each joint of a drive with one of `LAWS`.

    Bristle stiffness and damping, kinetic and static torque (equal for `dahl`), and Stribeck velocity.
    """
    values, nv = fitted.values["friction"], fitted.bench.nv
    by_joint = {name: values[name][param.members(nv)] for name, param in fitted.model.params.items()}
    if fitted.model.name == "dahl":
        torque = by_joint["coulomb_torque"]
        by_joint |= {"micro_damping": np.zeros(nv), "kinetic_torque": torque, "static_torque": torque}
        by_joint["stribeck_velocity"] = np.ones(nv)
    return np.stack([by_joint[name] for name in _LUGRE], axis=1).tolist()


def run_native(text: str, fitted: FittedDrive) -> Float[np.ndarray, "batch time nv"]:
    """Simulate the long test rollouts in MuJoCo C from the friction model's initial deflection; return positions."""
    segments, bench = fitted.segments, fitted.bench
    initial = fitted.samples.map(lambda signal: signal.reshape(segments.count, segments.length, bench.nv)[:, 0])
    deflection = fitted.model.settle(np, fitted.values["friction"], initial)[..., 0]

    def begin(data: mujoco.MjData, rollout: int) -> None:
        data.act[:] = deflection[rollout]

    return run_loaded(mujoco.MjModel.from_xml_string(text), fitted, begin=begin)


def _run(folder: Path, fitted: FittedDrive) -> np.ndarray:
    module: Any = load_module(folder / MODULE)
    model = mujoco.MjModel.from_xml_path(str(folder / BENCH))
    drive = module.Drive(model)

    def prepare(data: mujoco.MjData, rollout: int) -> None:
        before = commands_before(fitted, rollout)
        drive.start_late(before.ctrl, before.inputs)

    def step(data: mujoco.MjData, signals: Signals) -> None:
        drive.step(data, signals.ctrl, signals.inputs | signals.observed)

    return simulate(model, fitted, step, prepare, late=False)
