"""What to do after a run, as three commands to copy: the law to try, the recording to make, the export."""

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.state import DriveState
from frictionzoo.excite.limits import Limits, refuse_unholdable
from frictionzoo.identification.problem import Problem
from frictionzoo.models import TorchFriction
from frictionzoo.models.by_joint import ByJoint
from frictionzoo.models.sees import SEES, observe, simpler_law, suggest_law
from frictionzoo.result.residual_types import ResidualRow

LEAST_TORQUE = 1.5  # times what holds the drive at rest, of a torque that a recording may take
FIRST_LAW = "mujoco_default"  # to try where nothing is to be compared with
TARGET = "mjcf"
_RUN, _EXCITE = "python -m frictionzoo.run", "python -m frictionzoo.excite"
_DISTILL = "python -m frictionzoo.distill"
_OF_THE_FOLDER = re.compile(r"[+~]*(resume|output)=")
_OF_THE_LAW = re.compile(r"[+~]*model\b")
_OF_THE_DRIVE = re.compile(r"(bench|data|experiment)=|(bench|scale)\.")
_OF_THE_DATA = re.compile(r"(data|experiment)\b")


@dataclass(frozen=True)
class Origin:
    """How a run was asked for.

    Attributes:
        command: What a shell was told before the options; None for a call from Python.
        options: `KEY=VALUE` each, those that choose the law and its parameters left out; of a call from Python the
            arguments that are not as they are where nothing is said, `NAME=VALUE` each.
        folder: The run's; None for one that is in memory only.
    """

    command: str | None = None
    options: tuple[str, ...] = ()
    folder: Path | None = None

    @classmethod
    def of_run(cls, options: Sequence[str], folder: Path, teacher: str | None = None) -> "Origin":
        """Of the command line, by the options of the job, and the folder of the drive that it follows, if any."""
        kept = [each for each in options if not _OF_THE_LAW.match(each) and not _OF_THE_FOLDER.match(each)]
        return cls(_RUN if teacher is None else f"{_DISTILL} {shlex.quote(teacher)}", tuple(kept), folder)

    @classmethod
    def of_call(cls, arguments: Mapping[str, Any]) -> "Origin":
        """Of `frictionzoo.identify`, by its arguments; what is no plain value stands by its name."""
        return cls(None, tuple(f"{name}={_write(name, value)}" for name, value in arguments.items()))

    @property
    def place(self) -> str:
        """The run's folder as this process sees it, for a shell."""
        folder = Path() if self.folder is None else self.folder
        inside = folder.is_absolute() and folder.is_relative_to(Path.cwd())
        return shlex.quote(str(folder.relative_to(Path.cwd()) if inside else folder))


IN_MEMORY = Origin()
"""A call from Python in which nothing else was said."""


def suggest_commands(
    problem: Problem, values: Mapping[str, Any], residual: ResidualRow | None, origin: Origin
) -> list[str]:
    """Three commands for a shell, or calls for Python.

    Args:
        problem: What was identified.
        values: Of the bench's parameters, by name.
        residual: What is left of the torque.
        origin: How it was asked for.
    """
    law = choose_law(problem, residual)
    limits = limits_of(problem, values)
    if origin.command is None:
        named = ", ".join([f"bench, {law!r}, logs", *origin.options])
        return [
            f"fz.identify({named})",
            _excite_in_python(problem, values, limits),
            f'drive.export("{TARGET}", "export")',
        ]
    chosen = _choose_in_shell(problem, law, residual)
    return [
        shlex.join([*shlex.split(origin.command), *origin.options, *chosen]),
        _excite_in_shell(problem, values, limits, law, origin),
        f"python -m frictionzoo.export {origin.place} target={TARGET}",
    ]


def choose_law(problem: Problem, residual: ResidualRow | None) -> str:
    """The law to try next: one that has what the error goes with; else one that has a term more, or a term less."""
    places = [place for row in residual["by_joint"] for place in row["places"]] if residual else []
    found = [place["law"] for place in sorted(places, key=lambda place: -place["share"])]
    if named := next(filter(None, found), None):
        return named
    model = problem.drive.model.of_joint(0)[0]
    sees = {*model.sees} or observe(model, problem.samples)
    further = [suggest_law(model, sees, what) for what in SEES if what not in sees and _is_recorded(problem, what)]
    richer = next((law for law, whole in further if law and whole), None)
    return richer or simpler_law(model, sees) or FIRST_LAW


def limits_of(problem: Problem, values: Mapping[str, Any]) -> dict[str, Any]:
    """What the training recordings show that the drive may do: `position`, `velocity` and `torque` of each joint.

    The torque is as large at least as the drive needs to be held.
    """
    seen: DriveState = problem.samples
    low, high = (np.quantile(seen.qpos, share, axis=0) for share in (0.001, 0.999))
    speed, torque = (np.quantile(np.abs(signal), 0.999, axis=0) for signal in (seen.qvel, seen.motor_torque))
    torque = np.maximum(torque, LEAST_TORQUE * _hold(problem, (low + high) / 2))
    several = problem.bench.nv > 1
    pairs = [[_round(a), _round(b)] for a, b in zip(low, high, strict=True)]
    speeds, torques = ([_round(each) for each in of] for of in (speed, torque))
    return {
        "position": pairs if several else pairs[0],
        "velocity": speeds if several else speeds[0],
        "torque": torques if several else torques[0],
    }


def _hold(problem: Problem, qpos: Float[np.ndarray, "nv"]) -> Float[np.ndarray, "nv"]:
    """Torque that holds the drive at a position [N m or N]."""
    model = problem.bench.compile(constraint=False)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return np.abs(data.qfrc_bias - data.qfrc_passive)


def _is_recorded(problem: Problem, what: str) -> bool:
    return what != "temperature" or all("temperature" in log.extras for log in problem.dataset.train)


def _choose_in_shell(problem: Problem, law: str, residual: ResidualRow | None) -> list[str]:
    """What chooses the law: where joints have laws of their own, they keep them but for those that lack something."""
    model = problem.drive.model
    if not isinstance(model, ByJoint):
        return [f"model={law}"]
    lacking = {row["joint"] for row in (residual["by_joint"] if residual else []) if row["places"]}
    joints = problem.bench.joints
    laws = {name: law if name in lacking else model.of_joint(at)[0].name for at, name in enumerate(joints)}
    return ["model=by_joint", f"model.laws={{{', '.join(f'{name}: {own}' for name, own in laws.items())}}}"]


def _inputs(problem: Problem) -> dict[str, Float[np.ndarray, "nv"]]:
    """What the actuator law usually gets besides the command."""
    signals = problem.segments.signals.inputs
    return {name: np.median(signal, axis=(0, 1)) for name, signal in signals.items() if name != "ctrl_velocity"}


def _excitable(problem: Problem, values: Mapping[str, Any], limits: Mapping[str, Any]) -> bool:
    """Whether a command of positions can be designed for the drive."""
    try:
        refuse_unholdable(problem.bench, values, _inputs(problem), Limits.read(problem.bench.nv, **limits))
    except ConfigError:
        return False
    return problem.drive.rollout.reverse


def _has_parameters(problem: Problem) -> bool:
    """Whether a recording can tell all that the run identified."""
    space = problem.objective.space
    return bool(space.params) and not space.weights and not isinstance(problem.drive.model, TorchFriction)


def _excite_in_shell(
    problem: Problem, values: Mapping[str, Any], limits: Mapping[str, Any], law: str, origin: Origin
) -> str:
    if not _excitable(problem, values, limits):
        data = [each for each in origin.options if _OF_THE_DATA.match(each)]
        return shlex.join(["python", "-m", "frictionzoo.inspect", *(data or ["data=twin"])]) + _NO_DESIGN
    stated = [f"{name}={_plain(value)}" for name, value in limits.items()]
    if _has_parameters(problem):
        return f"{_EXCITE} {origin.place} {shlex.join(stated)}"
    about = [each for each in origin.options if _OF_THE_DRIVE.match(each)]
    inputs = [f"inputs.{name}={_round(np.median(usual))}" for name, usual in _inputs(problem).items()]
    return shlex.join([*_EXCITE.split(), *about, f"model={law}", *stated, *inputs])


def _excite_in_python(problem: Problem, values: Mapping[str, Any], limits: Mapping[str, Any]) -> str:
    if not _excitable(problem, values, limits) or not _has_parameters(problem):
        return f"logs{_NO_DESIGN}"
    stated = {name: _plain(value) for name, value in limits.items()}
    return f'from frictionzoo.excite.excitation import excite; excite({stated!r}, drive).save("excitation")'


_NO_DESIGN = "  # what there is: record more of what it lacks; no command can be designed for this drive"


def _plain(value: Any) -> str:
    """A limit as an option has it."""
    return str(value).replace(" ", "")


def _round(value: float | np.floating) -> float:
    return float(f"{value:.3g}")


def _write(name: str, value: Any) -> str:
    """An argument of a call, by its name where no text makes it again."""
    text = repr(value)
    plain = isinstance(value, str | int | float | bool | None) or (
        isinstance(value, dict | list | tuple) and not re.search(r"[<(]", text)
    )
    return text if plain else name
