"""Suggested commands after a run: a repair, the next model to try, the next recording, the export."""

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.bench.limits import Limits, refuse_unholdable
from frictionzoo.bench.torque import actuator_torque, stall_torque
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.log import Log
from frictionzoo.diagnostics.findings import Repair
from frictionzoo.identification.problem import Problem
from frictionzoo.models import TorchFriction
from frictionzoo.models.by_joint import ByJoint
from frictionzoo.models.sees import SEES, observe, simpler_law, suggest_law
from frictionzoo.result.section_types import Residual, SuggestedCommand

FIRST_LAW = "mujoco_default"  # suggested if no other model is
_INSPECT, _DESIGN = (["python", "-m", f"frictionzoo.{name}"] for name in ("inspect", "design"))
_OF_THE_FOLDER = re.compile(r"[+~]*(resume|output)=")
_OF_THE_LAW = re.compile(r"[+~]*model\b")
_OF_THE_DRIVE = re.compile(r"(bench|data|experiment)=|(bench|scale)\.")
_OF_THE_DATA = re.compile(r"(data|experiment)\b")
_USUAL = 0.999  # quantile of the samples within a limit: samples beyond may be outliers
_SIGN = "data.sign."
_WIDER = 10.0  # distance factor of a new bound from a repaired value outside the bounds


@dataclass(frozen=True)
class Origin:
    """The shell command of a run: its beginning, its options `KEY=VALUE`, its folder, and the options of its model."""

    command: str
    options: tuple[str, ...]
    folder: Path
    law: tuple[str, ...] = ()

    @classmethod
    def of_run(cls, options: Sequence[str], folder: Path, teacher: str | None = None) -> "Origin":
        """Return the origin of a command-line run from its options, its folder and, if it has one, its teacher's."""
        kept = [each for each in options if not _OF_THE_LAW.match(each) and not _OF_THE_FOLDER.match(each)]
        law = tuple(each for each in options if _OF_THE_LAW.match(each))
        program = "run" if teacher is None else f"distill {shlex.quote(teacher)}"
        return cls(f"python -m frictionzoo.{program}", tuple(kept), folder, law)

    @property
    def place(self) -> str:
        """The run's folder, quoted for a shell; relative if it is inside the working directory."""
        inside = self.folder.is_absolute() and self.folder.is_relative_to(Path.cwd())
        return shlex.quote(str(self.folder.relative_to(Path.cwd()) if inside else self.folder))


def suggest_commands(
    problem: Problem, values: Mapping[str, Any], residual: Residual | None, origin: Origin
) -> list[SuggestedCommand]:
    """Return commands for a shell, after a run with this `origin`; the verdict may still drop some.

    `values` are the bench's parameters by name.
    """
    law = choose_law(problem, residual)
    limits = recorded_limits(problem.bench, values, problem.dataset.train)
    # Of the first finding that has repairs, and of all findings that set the same options.
    options = [{repair.option for repair in doubt.repairs} for doubt in problem.doubts]
    first = next(filter(None, options), set())
    alike = [doubt.repairs for doubt, its in zip(problem.doubts, options, strict=True) if its == first]
    repairs = complete_options(chain.from_iterable(alike), problem.bench, problem.settings)
    run, found = shlex.split(origin.command), dict[Any, str]()
    if repairs:
        kept = [each for each in (*origin.options, *origin.law) if each.partition("=")[0].lstrip("+~") not in repairs]
        found["repair"] = shlex.join([*run, *kept, *_as_options(repairs)])
    data = [each for each in origin.options if _OF_THE_DATA.match(each)] or ["data=twin"]
    found["inspect"] = shlex.join([*_INSPECT, *data])
    found["law"] = shlex.join([*run, *origin.options, *_options_of_law(problem, law, residual)])
    if _is_excitable(problem, values, limits):
        found["recording"] = _design_in_shell(problem, limits, law, origin)
    else:
        found["inspect"] += "  # no command can be designed for this drive; record the motion that is missing"
    found["export"] = f"python -m frictionzoo.export {origin.place} target={problem.drive.model.export_target}"
    return [SuggestedCommand(kind, command) for kind, command in found.items()]


def complete_options(repairs: Iterable[Repair], bench: Bench, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that make all these repairs; lists have an entry for each joint, repaired or not.

    The first repair of an option and joint counts; `settings` are all options of the run.
    """
    options: dict[str, Any] = {}
    done: set[tuple[str, int | None]] = set()
    for repair in repairs:
        option, value, joint = repair.option, repair.value, repair.joint
        if (option, joint) in done:
            continue
        done.add((option, joint))
        if joint is None:
            options.setdefault(option, value)
            continue
        if option.startswith(_SIGN):
            sign = (settings["data"].get("sign") or {}).get(option.removeprefix(_SIGN), 1)
            present = np.broadcast_to(sign, bench.nv).tolist()
        else:
            present = bench.initial_values()[option.partition(".params.")[2].partition(".")[0]].tolist()
        entries = options.setdefault(option, present)
        if repair.is_factor:
            value = entries[joint] * value
            value = value if isinstance(value, int) else float(f"{value:.4g}")  # a sign stays whole
        entries[joint] = value
    options |= _widen(options, settings)
    return {name: value[0] if isinstance(value, list) and len(value) == 1 else value for name, value in options.items()}


def _widen(options: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return wider bounds for parameters that a repair puts outside their current bounds."""
    wider: dict[str, Any] = {}
    for option, values in options.items():
        *path, last = option.split(".")
        section: Any = settings
        for name in path:
            section = section.get(name, {}) if isinstance(section, Mapping) else {}
        if last != "init" or not isinstance(section, Mapping):
            continue
        low, high = section.get("low"), section.get("high")
        stem = ".".join(path)
        if isinstance(high, int | float) and max(values) > high:
            wider[f"{stem}.high"] = _WIDER * max(values)
        if isinstance(low, int | float) and min(values) < low:
            wider[f"{stem}.low"] = min(values) / _WIDER
    return wider


def choose_law(problem: Problem, residual: Residual | None) -> str:
    """Return the friction model to try next.

    It is one with the term that the residual torque asks for; else one with one term more; else one with one term less.
    """
    places = [place for row in residual.by_joint for place in row.places] if residual else []
    found = [place.law for place in sorted(places, key=lambda place: -place.share)]
    if named := next(filter(None, found), None):
        return named
    model = problem.drive.model.of_joint(0)[0]
    sees = {*model.sees} or observe(model, problem.samples)
    logs = problem.dataset.train
    recorded = {*SEES} - ({"temperature"} if any("temperature" not in log.extras for log in logs) else set())
    further = [suggest_law(model, sees, what) for what in SEES if what in recorded - sees]
    richer = next((law for law, whole in further if law and whole), None)
    return richer or simpler_law(model, sees) or FIRST_LAW


def _options_of_law(problem: Problem, law: str, residual: Residual | None) -> list[str]:
    """Return the options that choose the next model; with a model per joint, only insufficient ones are replaced."""
    model = problem.drive.model
    if not isinstance(model, ByJoint):
        return [f"model={law}"]
    lacking = {row.joint for row in (residual.by_joint if residual else []) if row.places}
    joints = problem.bench.joints
    laws = {name: law if name in lacking else model.of_joint(at)[0].name for at, name in enumerate(joints)}
    return ["model=by_joint", f"model.laws={{{', '.join(f'{name}: {own}' for name, own in laws.items())}}}"]


def _is_excitable(problem: Problem, values: Mapping[str, Any], limits: Mapping[str, Any]) -> bool:
    try:
        inputs = _holding_inputs(problem.bench, problem.dataset.train)
        refuse_unholdable(problem.bench, values, inputs, Limits.read(problem.bench.nv, **limits))
    except ConfigError:
        return False
    return problem.drive.engine.reverse


def _design_in_shell(problem: Problem, limits: Mapping[str, Any], law: str, origin: Origin) -> str:
    space, stated = problem.objective.space, _as_options(limits)
    if space.params and not space.weights and not isinstance(problem.drive.model, TorchFriction):
        return f"{shlex.join(_DESIGN)} {origin.place} {shlex.join(stated)}"
    # Not only physical parameters were identified, so there is no information on them to design for.
    about = [each for each in origin.options if _OF_THE_DRIVE.match(each)]
    usual = _usual_inputs(problem.bench, problem.dataset.train)
    inputs = [f"inputs.{name}={float(f'{np.median(values):.3g}')}" for name, values in usual.items()]
    return shlex.join([*_DESIGN, *about, f"model={law}", *stated, *inputs])


def _as_options(values: Mapping[str, Any]) -> list[str]:
    texts = {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in values.items()}
    return [f"{name}={text.replace(' ', '')}" for name, text in texts.items()]


def _usual_inputs(bench: Bench, logs: Sequence[Log]) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the actuator model's median inputs in accepted logs, without feed-forward commands."""
    actuator = bench.actuator
    feed_forward = set(actuator.commands) & set(actuator.optional_inputs)
    names = [name for name in actuator.inputs if name not in feed_forward]
    return {name: np.median(np.concatenate([log.inputs[name] for log in logs]), axis=0) for name in names}


def _holding_inputs(bench: Bench, logs: Sequence[Log]) -> dict[str, Float[np.ndarray, "nv"]]:
    """Return the actuator model's inputs at standstill: median ones, and no feed-forward commands."""
    return {name: np.zeros(bench.nv) for name in bench.actuator.inputs} | _usual_inputs(bench, logs)


def recorded_limits(bench: Bench, values: Mapping[str, Any], logs: Sequence[Log]) -> dict[str, Any]:
    """Return the limits `position`, `velocity` and `torque` of each joint as options of `frictionzoo.design`.

    No limit exceeds the recorded motion. The torque is the identified actuator's at the recorded states, at most its
    torque at standstill. All limits are rounded down in magnitude. `values` are the bench's identified parameters, each
    of shape (nv,); `logs` are training logs that the bench has accepted.
    """
    qpos = np.concatenate([log.qpos for log in logs])
    low, high = (np.quantile(qpos, share, axis=0) for share in (1 - _USUAL, _USUAL))
    velocity = np.quantile(np.abs(np.concatenate([log.qvel for log in logs])), _USUAL, axis=0)
    used_torque = np.quantile(
        np.abs(np.concatenate([actuator_torque(bench, log, values) for log in logs])), _USUAL, axis=0
    )
    torque = np.minimum(used_torque, stall_torque(bench, values, _holding_inputs(bench, logs), (low + high) / 2))
    pairs = [[-round_down(-a), round_down(b)] for a, b in zip(low, high, strict=True)]
    limits = {"position": pairs, "velocity": list(map(round_down, velocity)), "torque": list(map(round_down, torque))}
    return limits if bench.nv > 1 else {name: limit[0] for name, limit in limits.items()}


def round_down(value: float) -> float:
    """Round down to three significant digits."""
    if not np.isfinite(value) or value == 0:
        return float(value)
    decimals = 2 - int(np.floor(np.log10(abs(value))))
    nearest = round(float(value), decimals)
    return nearest if nearest <= value else round(nearest - 10.0**-decimals, decimals)
