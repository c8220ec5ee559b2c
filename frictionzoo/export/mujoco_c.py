"""Target `mujoco`: a Python module with the friction model inside MuJoCo's step."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import Signals
from frictionzoo.core.templates import Code
from frictionzoo.export.base import Target, measure, register_target
from frictionzoo.export.bench import say_limits
from frictionzoo.export.module import controls, load_module, write_module
from frictionzoo.export.native import REASON, run_native, write_native
from frictionzoo.export.nearest import Nearest
from frictionzoo.export.simulate import PAYLOADS, commands_before, simulate
from frictionzoo.export.written import Export
from frictionzoo.result.fitted_drive import FittedDrive

MODULE, BENCH = "drive.py", "bench.xml"
FORMS = ("module", "native")


@register_target("mujoco")
class MujocoC(Target):
    """Python module with the exact friction model inside MuJoCo C's step; needs only numpy and mujoco."""

    options: ClassVar[Mapping[str, str]] = {
        "law": "module, its own formula in Python, or native, MuJoCo's dcmotor for lugre and dahl"
    }
    packages: ClassVar[tuple[str, ...]] = ("mujoco", "numpy")

    def write(self, fitted: FittedDrive, folder: Path, options: Mapping[str, str]) -> Export:
        """See `Target.write`."""
        law = options.get("law", FORMS[0])
        if law not in FORMS:
            raise ConfigError(f"law={law}; expected {' or '.join(FORMS)}")
        if law == "native":
            return _write_native(fitted, folder)
        (folder / BENCH).write_text(write_bare_bench(fitted))
        written = write_module(
            *(fitted, folder, "mujoco_drive.py.jinja", MODULE),
            example_install=Code("drive.command[:] = ..." if controls(fitted) else "data.ctrl[...] = ..."),
        )
        limits = ["It runs as MuJoCo's control callback, in Python: a step takes longer than without."]
        limits += [PAYLOADS] if fitted.bench.payload is not None else []
        difference = measure("qpos", fitted, _run(folder, fitted), fitted.rollout()[0])
        return Export((*written, BENCH), (difference,), tuple(limits))


def _write_native(fitted: FittedDrive, folder: Path) -> Export:
    text = write_native(fitted)
    (folder / BENCH).write_text(text)
    difference = measure("qpos", fitted, run_native(text, fitted), fitted.rollout()[0], reason=REASON)
    limits = [
        f"{REASON}: the equations are one, and so are the motions as steps get short; stiff bristles need shorter "
        "steps than the drive.",
        "`act` of the dcmotor is the bend of the bristles: 0 is a joint without load, not one that holds it; the "
        "difference begins with the drive's own.",
    ]
    exact = Nearest(dict(fitted.values["bench"]), np.zeros(fitted.bench.nv), np.zeros(fitted.bench.nv))
    return Export((BENCH,), (difference,), (*limits, *say_limits(fitted, exact)))


def write_bare_bench(fitted: FittedDrive, frictionloss: np.ndarray | None = None) -> str:
    """Return the bench's MJCF without friction and delay, which the module adds."""
    values = {name: value for name, value in fitted.values["bench"].items() if name != "delay"}
    return fitted.bench.mjcf(values, frictionloss, comments=(f"Friction is in {MODULE} beside this file.",))


def _run(folder: Path, fitted: FittedDrive) -> np.ndarray:
    module: Any = load_module(folder / MODULE)
    model = mujoco.MjModel.from_xml_path(str(folder / BENCH))
    drive = module.Drive(model)

    def prepare(model: mujoco.MjModel, data: mujoco.MjData, rollout: int) -> None:
        before = commands_before(fitted, rollout)
        drive.start_late(before.ctrl, before.inputs)

    def step(model: mujoco.MjModel, data: mujoco.MjData, signals: Signals) -> None:
        drive.step(data, signals.ctrl, signals.inputs | signals.observed)

    return simulate(model, fitted, step, prepare, late=False)
