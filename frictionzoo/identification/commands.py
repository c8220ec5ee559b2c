"""Suggested commands after a run: a repair, the next model to try, the next recording, the export."""

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.limits import Limits, refuse_unholdable
from frictionzoo.core.errors import ConfigError
from frictionzoo.diagnostics.findings import Repair
from frictionzoo.identification.problem import Problem
from frictionzoo.identification.recorded_limits import recorded_limits, usual_inputs
from frictionzoo.identification.repairs import bench_call, complete_options, logs_call
from frictionzoo.models import TorchFriction
from frictionzoo.models.by_joint import ByJoint
from frictionzoo.models.sees import SEES, observe, simpler_law, suggest_law
from frictionzoo.result.residual_types import ResidualRow
from frictionzoo.result.verdict_types import CommandRow

FIRST_LAW = "mujoco_default"  # suggested if no other model is
TARGET = "mjcf"
_RUN, _EXCITE = "python -m frictionzoo.run", "python -m frictionzoo.design"
_DISTILL = "python -m frictionzoo.distill"
_OF_THE_FOLDER = re.compile(r"[+~]*(resume|output)=")
_OF_THE_LAW = re.compile(r"[+~]*model\b")
_OF_THE_DRIVE = re.compile(r"(bench|data|experiment)=|(bench|scale)\.")
_OF_THE_DATA = re.compile(r"(data|experiment)\b")


@dataclass(frozen=True)
class Origin:
    """The request for a run, from a shell or from Python.

    Attributes:
        command: The shell command before the options; None for a call from Python.
        options: Options as `KEY=VALUE`, without those in `law`; for a call from Python, the arguments that differ from
            their defaults, as `NAME=VALUE`.
        folder: The run's folder; None for a run in memory.
        law: Shell options that choose the friction model and its parameters.
    """

    command: str | None = None
    options: tuple[str, ...] = ()
    folder: Path | None = None
    law: tuple[str, ...] = ()

    @classmethod
    def of_run(cls, options: Sequence[str], folder: Path, teacher: str | None = None) -> "Origin":
        """Return the origin of a command-line run from its options, its folder and, if it has one, its teacher's."""
        kept = [each for each in options if not _OF_THE_LAW.match(each) and not _OF_THE_FOLDER.match(each)]
        law = tuple(each for each in options if _OF_THE_LAW.match(each))
        return cls(_RUN if teacher is None else f"{_DISTILL} {shlex.quote(teacher)}", tuple(kept), folder, law)

    @classmethod
    def of_call(cls, arguments: Mapping[str, Any]) -> "Origin":
        """Return the origin of a call of `frictionzoo.identify`; arguments without a plain value appear by name."""
        return cls(None, tuple(f"{name}={_write(name, value)}" for name, value in arguments.items()))

    @property
    def place(self) -> str:
        """The run's folder, quoted for a shell; relative if it is inside the working directory."""
        folder = Path() if self.folder is None else self.folder
        inside = folder.is_absolute() and folder.is_relative_to(Path.cwd())
        return shlex.quote(str(folder.relative_to(Path.cwd()) if inside else folder))


IN_MEMORY = Origin()
"""A call from Python with default arguments."""


def suggest_commands(
    problem: Problem, values: Mapping[str, Any], residual: ResidualRow | None, origin: Origin
) -> list[CommandRow]:
    """Return commands for a shell, or calls for Python; the verdict may still drop some.

    Args:
        problem: The problem that was identified.
        values: Values of the bench's parameters, by name.
        residual: The residual torque.
        origin: The request for the run.
    """
    law = choose_law(problem, residual)
    limits = recorded_limits(problem.bench, values, problem.dataset.train)
    repairs = complete_options(_list_repairs(problem), problem.bench, problem.settings)
    excitable, found = _excitable(problem, values, limits), dict[str, str]()
    if origin.command is None:
        if repairs:
            found["repair"] = _repair_in_python(problem, repairs, origin)
        found["inspect"] = f"logs{'' if excitable else _NO_DESIGN}"
        found["law"] = f"fz.identify({', '.join([f'bench, {law!r}, logs', *origin.options])})"
        if excitable and _has_parameters(problem):
            found["recording"] = _excite_in_python(limits)
        found["export"] = f'drive.export("{TARGET}", "export")'
        return _rows(found)
    if repairs:
        found["repair"] = _repair_in_shell(repairs, origin)
    found["inspect"] = _inspect_in_shell(origin) + ("" if excitable else _NO_DESIGN)
    chosen = _choose_in_shell(problem, law, residual)
    found["law"] = shlex.join([*shlex.split(origin.command), *origin.options, *chosen])
    if excitable:
        found["recording"] = _excite_in_shell(problem, limits, law, origin)
    found["export"] = f"python -m frictionzoo.export {origin.place} target={TARGET}"
    return _rows(found)


def _rows(commands: Mapping[str, str]) -> list[CommandRow]:
    return [cast(CommandRow, {"kind": kind, "command": command}) for kind, command in commands.items()]


def _list_repairs(problem: Problem) -> list[Repair]:
    """Return the repairs of the first finding that has some, and of all findings that set the same options."""
    first = next((doubt.repairs for doubt in problem.doubts if doubt.repairs), ())
    options = {repair.option for repair in first}
    alike = [doubt.repairs for doubt in problem.doubts if {repair.option for repair in doubt.repairs} == options]
    return [repair for repairs in alike for repair in repairs]


def _repair_in_shell(repairs: Mapping[str, Any], origin: Origin) -> str:
    """Return the command of the same run with repaired options."""
    kept = [each for each in (*origin.options, *origin.law) if each.partition("=")[0].lstrip("+~") not in repairs]
    changed = [f"{name}={_plain(value)}" for name, value in repairs.items()]
    return shlex.join([*shlex.split(origin.command or _RUN), *kept, *changed])


def _repair_in_python(problem: Problem, repairs: Mapping[str, Any], origin: Origin) -> str:
    model = problem.drive.model
    law: Any = model.name
    if isinstance(model, ByJoint):
        law = {re.escape(name): model.of_joint(at)[0].name for at, name in enumerate(problem.bench.joints)}
    logs = logs_call(repairs, problem.settings["data"])
    if logs is None:
        wanted = ", ".join(f"{name}={_plain(value)}" for name, value in repairs.items() if name.startswith("data."))
        return f"logs  # not read from files: apply {wanted} to them"
    return f"fz.identify({', '.join([bench_call(repairs), repr(law), logs, *origin.options])})"


def _inspect_in_shell(origin: Origin) -> str:
    data = [each for each in origin.options if _OF_THE_DATA.match(each)]
    return shlex.join(["python", "-m", "frictionzoo.inspect", *(data or ["data=twin"])])


def choose_law(problem: Problem, residual: ResidualRow | None) -> str:
    """Return the friction model to try next.

    It is one with the term that the residual torque asks for; else one with one term more; else one with one term less.
    """
    places = [place for row in residual["by_joint"] for place in row["places"]] if residual else []
    found = [place["law"] for place in sorted(places, key=lambda place: -place["share"])]
    if named := next(filter(None, found), None):
        return named
    model = problem.drive.model.of_joint(0)[0]
    sees = {*model.sees} or observe(model, problem.samples)
    further = [suggest_law(model, sees, what) for what in SEES if what not in sees and _is_recorded(problem, what)]
    richer = next((law for law, whole in further if law and whole), None)
    return richer or simpler_law(model, sees) or FIRST_LAW


def _is_recorded(problem: Problem, what: str) -> bool:
    return what != "temperature" or all("temperature" in log.extras for log in problem.dataset.train)


def _choose_in_shell(problem: Problem, law: str, residual: ResidualRow | None) -> list[str]:
    """Return the options that choose the next model; with a model per joint, only insufficient ones are replaced."""
    model = problem.drive.model
    if not isinstance(model, ByJoint):
        return [f"model={law}"]
    lacking = {row["joint"] for row in (residual["by_joint"] if residual else []) if row["places"]}
    joints = problem.bench.joints
    laws = {name: law if name in lacking else model.of_joint(at)[0].name for at, name in enumerate(joints)}
    return ["model=by_joint", f"model.laws={{{', '.join(f'{name}: {own}' for name, own in laws.items())}}}"]


def _excitable(problem: Problem, values: Mapping[str, Any], limits: Mapping[str, Any]) -> bool:
    """Return whether the experiment design supports this drive."""
    try:
        inputs = {name: np.zeros(problem.bench.nv) for name in problem.bench.actuator.inputs} | _usual(problem)
        refuse_unholdable(problem.bench, values, inputs, Limits.read(problem.bench.nv, **limits))
    except ConfigError:
        return False
    return problem.drive.rollout.reverse


def _usual(problem: Problem) -> dict[str, Float[np.ndarray, "nv"]]:
    return usual_inputs(problem.bench, problem.dataset.train)


def _has_parameters(problem: Problem) -> bool:
    """Return whether everything identified is a physical parameter, so that its information can be designed for."""
    space = problem.objective.space
    return bool(space.params) and not space.weights and not isinstance(problem.drive.model, TorchFriction)


def _excite_in_shell(problem: Problem, limits: Mapping[str, Any], law: str, origin: Origin) -> str:
    stated = [f"{name}={_plain(value)}" for name, value in limits.items()]
    if _has_parameters(problem):
        return f"{_EXCITE} {origin.place} {shlex.join(stated)}"
    about = [each for each in origin.options if _OF_THE_DRIVE.match(each)]
    inputs = [f"inputs.{name}={_round(np.median(usual))}" for name, usual in _usual(problem).items()]
    return shlex.join([*_EXCITE.split(), *about, f"model={law}", *stated, *inputs])


def _excite_in_python(limits: Mapping[str, Any]) -> str:
    return f'fz.design_recording({_texts(limits)!r}, drive).save("excitation")'


def _texts(limits: Mapping[str, Any]) -> dict[str, str]:
    return {name: _plain(value) for name, value in limits.items()}


_NO_DESIGN = "  # no command can be designed for this drive; record the motion that is missing"


def _plain(value: Any) -> str:
    """Return a value as an option writes it."""
    return str(value).lower() if isinstance(value, bool) else str(value).replace(" ", "")


def _round(value: float | np.floating) -> float:
    return float(f"{value:.3g}")


def _write(name: str, value: Any) -> str:
    """Return an argument of a call as code, or its name if its text is no literal."""
    text = repr(value)
    plain = isinstance(value, str | int | float | bool | None) or (
        isinstance(value, dict | list | tuple) and not re.search(r"[<(]", text)
    )
    return text if plain else name
