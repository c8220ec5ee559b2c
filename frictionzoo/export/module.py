"""Self-contained Python modules with a drive's friction model and values."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from frictionzoo import __version__
from frictionzoo.core.errors import ExportError
from frictionzoo.core.templates import Code, open_template
from frictionzoo.export.graph import signals
from frictionzoo.export.source import SourceText, read_source, write_values
from frictionzoo.models import TorchFriction
from frictionzoo.result.fitted_drive import FittedDrive

MODULE, BENCH, WEIGHTS = "drive.py", "bench.xml", "weights.npz"


def write_drive(
    fitted: FittedDrive, folder: Path, template: str, frictionloss: np.ndarray | None = None, **more: Any
) -> tuple[str, ...]:
    """Write a module and the bench's MJCF without the friction and the delay, which the module adds.

    See `write_module`.
    """
    values = {name: value for name, value in fitted.values["bench"].items() if name != "delay"}
    remarks = (f"Friction is in {MODULE} beside this file.",)
    (folder / BENCH).write_text(fitted.bench.mjcf(values, frictionloss, comments=remarks))
    return (*write_module(fitted, folder, template, MODULE, **more), BENCH)


def write_module(fitted: FittedDrive, folder: Path, template: str, name: str, **more: Any) -> tuple[str, ...]:
    """Write a module and, for a network, a file with its weights; return the names of the files.

    `more` has further variables of the template.

    Raises:
        ExportError: The model cannot be written as source text.
    """
    if isinstance(fitted.model, TorchFriction):
        raise ExportError(
            f"{fitted.model.name}: it exists only in torch, expected a formula that can be written down; take "
            "target=torchscript or onnx"
        )
    model, bench = fitted.model, fitted.bench
    values, large = write_values(fitted.values["friction"])
    advance = "advance_midway" if fitted.is_simulated else "advance"
    law = read_source(model, *(("terms", "settle", advance) if model.memory else ("terms",)))
    actuator, shared = read_source(bench.actuator, "control"), SourceText()
    shared.take(law)
    shared.take(actuator)
    text = render(
        template,
        units={dimension: Code(unit) for dimension, unit in fitted.units.items()},
        imports=[Code(text) for text in shared.imports.values() if text != "import numpy as np"],
        functions=[Code(text) for text in shared.functions.values()],
        law_class=law.as_class("Law", "Friction model, MODEL in frictionzoo."),
        actuator_class=actuator.as_class("Actuator", "Actuator model, ACTUATOR_LAW in frictionzoo."),
        model=model.name,
        actuator_law=type(bench.actuator).__name__,
        joints=bench.joints,
        timestep=fitted.timestep,
        inputs=tuple(bench.actuator.inputs),
        commands=bench.actuator.commands,
        without=dict(bench.actuator.optional_inputs),
        observed=bench.observed,
        signals=signals(model),
        example_inputs=Code(", inputs" if bench.inputs else ""),
        values=values,
        weights=WEIGHTS if large else "",
        actuator=write_values(fitted.values["bench"])[0],
        constraint=model.constraint,
        memory=model.memory,
        advance=Code(advance),
        controls=controls(fitted),
        **more,
    )
    (folder / name).write_text(text, encoding="utf-8")
    if not large:
        return (name,)
    np.savez(folder / WEIGHTS, **large)  # pyright: ignore[reportArgumentType] - a keyword is a name here
    return (name, WEIGHTS)


def render(template: str, **context: Any) -> str:
    """Render a Python file from a template of this package; text becomes a literal, except `Code`."""
    return open_template(f"export/{template}").render(version=Code(__version__), **context).lstrip()


def controls(fitted: FittedDrive) -> bool:
    """Return whether `ctrl` of MuJoCo's actuator differs from the command."""
    return "delay" in fitted.values["bench"] or fitted.bench.actuator.has_controller


def load_module(path: Path) -> ModuleType:
    """Import a written module."""
    spec = importlib.util.spec_from_file_location(f"frictionzoo_export_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
