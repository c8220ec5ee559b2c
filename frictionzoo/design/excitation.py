"""Experiment design: the next command to record within limits, checked in MuJoCo C, with its expected accuracy."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.bench import Bench
from frictionzoo.bench.compiled import NO_PAYLOAD
from frictionzoo.bench.limits import KINDS, Limits, Motion, refuse_unholdable
from frictionzoo.core.build import build
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.telling import tell
from frictionzoo.core.units import UNITS
from frictionzoo.design.design import design, scale_within
from frictionzoo.design.information import relative
from frictionzoo.design.plan import Request
from frictionzoo.design.steps import list_steps
from frictionzoo.design.task import Task
from frictionzoo.fit import Space
from frictionzoo.fit.uncertainty import WIDEST
from frictionzoo.models import FrictionModel, TorchFriction
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.names import list_widths
from frictionzoo.simulation.context import computing
from frictionzoo.simulation.drive import Drive


@dataclass(frozen=True)
class DesignedCommand:
    """A command ready to record.

    Attributes:
        motion: The command at each sample, and its motion in MuJoCo C.
        inputs: Further commands of the actuator model by name.
        interval: Time between samples [s].
        note: Content of `excitation.json`.
    """

    motion: Motion
    inputs: Mapping[str, Float[np.ndarray, "samples nv"]]
    interval: float
    note: Mapping[str, Any]


def excite(options: Mapping[str, str], run: FittedDrive | None = None) -> DesignedCommand:
    """Design the next command to record.

    Args:
        options: Options by name, as text: the limits `position`, `velocity` and `torque`; those of `Plan`, `Noise` and
            `Search`; `home`; `inputs.NAME`; and options of a run that choose the drive and its fit.
        run: The run whose identified values describe the drive; None for the initial values of conf/.

    Raises:
        FrictionzooError: An option or the run is invalid, or no command keeps the limits.
    """
    request = Request.read(options, run)
    plan, settings = request.plan, request.settings
    with computing("float64", settings["device"], settings["compilation_cache"]):
        task = prepare(request, run)
        limits = Limits.read(task.bench.nv, **request.limits)
        refuse_unholdable(task.bench, task.values["bench"], task.constants, limits)
        reduced, series = limits.within(1 - plan.margin), plan.series(task.sampling.interval, task.length)
        if task.segments(series.shortened.samples) < 2:
            raise ConfigError(
                f"seconds={plan.seconds:g}: fewer than two of the fit's segments of {task.length} samples; "
                "record for longer or lower segments.length"
            )
        optimum = design(task, series.shortened, reduced, request.search, _known_before(task.space, run))
        tell("design: scaling to the limits, verification in MuJoCo C")
        coefficients, information = scale_within(task, series, reduced, optimum.coefficients)
        ctrl, speed = series.command(np, coefficients, limits.home)
        motion, motion_in_steps = task.see_in_c(ctrl, speed, limits.home)
        half = task.half_widths(information, task.segments(series.samples))[0]
    used = motion_in_steps.shares(np, limits).max(axis=1)
    _refuse_beyond(used, task.bench)
    note = {
        "run": None if run is None else str(Path(run.place).resolve()),
        "model": task.drive.model.name,
        "joints": list(task.bench.joints),
        "parameters": _list_parameters(task, half, run),
        "limits": _list_limits(task.bench, limits, motion_in_steps, used),
        "command": {**asdict(plan), "rate": 1 / series.interval, "home": limits.home.tolist()},
        "noise": asdict(request.noise),
        "search": {**asdict(request.search), "began": optimum.first.tolist(), "ended": optimum.values.tolist()},
        "fit": {"length": task.length, "weights": list(task.weights)},
        "next": list_steps(
            options, None if run is None else run.place, settings, task.bench, task.drive.model, task.length
        ),
    }
    inputs = {"ctrl_velocity": speed} | {name: np.tile(value, (len(ctrl), 1)) for name, value in task.constants.items()}
    commands = {name: inputs[name] for name in task.bench.actuator.commands}
    return DesignedCommand(motion, commands, series.interval, note)


def prepare(request: Request, run: FittedDrive | None) -> Task:
    """Build the requested drive, simulated in float64; call it in a `computing` context of that type.

    Raises:
        FrictionzooError: The bench, model or run is invalid, or no recording can determine the parameters.
    """
    settings = request.settings
    bench: Bench = build(settings["bench"], Bench)
    model = build(settings["model"], FrictionModel, nv=bench.nv) if run is None else run.model
    if run is None:
        model.bind(bench.joints)
        model.begin(bench.initial_friction(model.params))
        model.double()
    bench = bench.observing(model.inputs)
    if isinstance(model, TorchFriction):
        raise ConfigError(f"{model.name} exists only in torch, with no exact sensitivities; use another model")
    interval = 1 / request.plan.rate if request.plan.rate else bench.timestep
    bench.check_interval(interval, f"rate={1 / interval:g}")
    constants = _pick_inputs(bench, request.inputs, run)
    space = Space(bench, model, "float64")
    if space.weights:
        raise ConfigError(
            f"{model.name}: a network, whose weights no recording determines; use a model with parameters"
        )
    if not space.names:
        raise ConfigError("nothing is identified, expected identified parameters; set identify=true for some")
    sampling = bench.sampling(interval)
    drive = Drive.assemble(bench, model, settings["engine"], sampling)
    if not drive.engine.reverse:
        raise ConfigError(f"engine={drive.engine.name}: no reverse mode for this bench; set engine=specialised")
    weights = float(settings["loss"]["position"]), float(settings["loss"]["velocity"])
    length = settings["segments"]["length"]
    length = max(2, round(0.1 / interval)) if length is None else int(length)  # by default a tenth of a second
    vector = np.asarray(space.start)
    if run is not None:
        identified = {name: run.parameters[name].value[place.first] for name, place in space.places.items()}
        vector = np.concatenate([space.params[name].to_coordinate(value, np) for name, value in identified.items()])
    fit = space, sampling, length, weights, request.noise
    return Task(bench, drive, *fit, vector, constants, bench.load(NO_PAYLOAD))


def _known_before(space: Space, run: FittedDrive | None) -> Float[np.ndarray, "coordinates"]:
    """Return half of each confidence interval of a run, in coordinates; 1 for a missing interval."""
    if run is None:
        return np.ones(len(space.start))
    half = []
    for name, place in space.places.items():
        low, high = run.parameters[name].interval[place.first].T
        half.append((space.params[name].to_coordinate(high, np) - space.params[name].to_coordinate(low, np)) / 2)
    half_intervals = np.concatenate(half)
    return np.where(np.isfinite(half_intervals) & (half_intervals > 0), half_intervals, 1.0)


def _pick_inputs(
    bench: Bench, given: Mapping[str, float], run: FittedDrive | None
) -> dict[str, Float[np.ndarray, "nv"]]:
    """Choose the constant inputs of the actuator model: given values, else medians of the run, else its defaults."""
    law, constants = bench.actuator, {}
    for name in given:
        if name not in law.inputs:
            needed = ", ".join(law.inputs) or "nothing"
            raise ConfigError(f"inputs.{name}: {type(law).__name__} needs {needed} besides the command; leave it out")
    for name in law.inputs:
        if name in given:
            constants[name] = np.full(bench.nv, given[name])
        elif name == "ctrl_velocity":
            continue  # the derivative of the command
        elif run is not None:
            constants[name] = np.median(run.recorded.signals.inputs[name], axis=(0, 1))
        elif name in law.optional_inputs:
            constants[name] = np.full(bench.nv, law.optional_inputs[name])
        else:
            raise ConfigError(f"inputs.{name} is missing: {type(law).__name__} needs it; give inputs.{name}=VALUE")
    return constants


def _refuse_beyond(used: Float[np.ndarray, "kinds nv"], bench: Bench) -> None:
    if not (used <= 1).all():
        kind, joint = np.unravel_index(np.argmax(np.nan_to_num(used, nan=np.inf)), used.shape)
        raise ConfigError(
            f"in MuJoCo C, the {KINDS[kind]} of {bench.joints[joint]} takes {used[kind, joint]:.3g} of its limit, "
            "expected at most 1; raise margin"
        )


def _list_parameters(
    task: Task, half: Float[np.ndarray, "coordinates"], run: FittedDrive | None
) -> list[dict[str, Any]]:
    """List a row for each coordinate: value, expected accuracy and present accuracy."""
    space = task.space
    rows, present = relative(space, task.vector, half), {} if run is None else list_widths(run.result.parameters)
    units = {name: param.unit(task.bench.joint_type) for name, param in space.params.items()}
    return [
        {
            "name": label,
            "unit": units[label.partition("/")[0]],
            "value": value,
            "half_width": width,
            "share": share,
            "share_now": present.get(label),
            "identifiable": bool(half_coordinate < WIDEST),
        }
        for (label, (value, width, share)), half_coordinate in zip(rows.items(), half.tolist(), strict=True)
    ]


def _list_limits(
    bench: Bench, limits: Limits, whole: Motion, used: Float[np.ndarray, "kinds nv"]
) -> list[dict[str, Any]]:
    """List a row for each limited quantity and joint: the range reached in MuJoCo C, and the allowed one."""
    ends = {"position": (limits.low, limits.high)}
    ends |= {kind: (-getattr(limits, kind), getattr(limits, kind)) for kind in ("velocity", "torque")}
    rows = []
    for kind, signal, share in zip(KINDS, whole, used, strict=True):
        quantity = kind.rpartition(" ")[2]
        for joint, name in enumerate(bench.joints):
            reached = [signal[:, joint].min(), signal[:, joint].max()]
            allowed = [end[joint] for end in ends[quantity]]
            row = {"joint": name, "quantity": kind, "unit": UNITS[bench.joint_type][quantity]}
            rows.append({**row, "reached": reached, "allowed": allowed, "share": share[joint]})
    return rows
