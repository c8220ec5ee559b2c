"""The ten lines of a notebook: read, identify, compare, load, and friction laws by name."""

import copy
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, Unpack, cast

import numpy as np
from omegaconf import DictConfig, OmegaConf

from frictionzoo.bench import Bench
from frictionzoo.comparison.compared import Compared
from frictionzoo.comparison.runs import Failure
from frictionzoo.core.build import build
from frictionzoo.core.config import check_overrides, compose_config, list_choices
from frictionzoo.core.described import describe, read_defaults
from frictionzoo.core.errors import ConfigError, FrictionzooError, LogError, RunError, closest
from frictionzoo.core.log import Log
from frictionzoo.core.segments import cut_segments
from frictionzoo.fit import Fit, Objective, run_fit
from frictionzoo.fit.base import REGISTRY as METHODS
from frictionzoo.identification import Problem, solve
from frictionzoo.logs.cache import digest
from frictionzoo.logs.clean import Cleaning
from frictionzoo.logs.files import AS_IT_IS, UPRIGHT, Files
from frictionzoo.logs.logs import Logs
from frictionzoo.logs.recording import Table
from frictionzoo.logs.split import Split
from frictionzoo.models.base import FrictionModel
from frictionzoo.models.registry import get_model
from frictionzoo.result.evaluate import Evaluation
from frictionzoo.result.identified import Identified
from frictionzoo.simulate.context import computing


class Cut(TypedDict, total=False):
    """What the fit compares, the arguments of `frictionzoo.core.segments.cut_segments`."""

    count: int | None
    length: int


class Loss(TypedDict, total=False):
    """What the fit minimises, the arguments of `frictionzoo.fit.Objective`."""

    position: float
    velocity: float
    robust: str
    robust_scale: float
    refine: bool


class Judging(TypedDict, total=False):
    """The rollouts that judge, the arguments of `frictionzoo.result.evaluate.Evaluation`."""

    horizons: Sequence[float]
    rollouts: int | None
    placement: str
    trajectory: float
    window: float
    places: int
    local: float
    seed: int


class Looping(TypedDict, total=False):
    """What happens around the fit, the arguments of `frictionzoo.fit.run_fit`."""

    chunk: int
    patience: int | None
    progress: bool


class How(TypedDict, total=False):
    """The options of `identify`, which describes them."""

    test: float | Split | None
    method: str | Fit
    segments: Cut
    loss: Loss
    evaluation: Judging
    loop: Looping
    scale: Mapping[str, float]
    seed: int
    dtype: str
    engine: str
    device: str
    compilation_cache: str | None


SECTIONS: dict[str, Callable[..., Any]] = {
    "segments": cut_segments,
    "loss": Objective,
    "evaluation": Evaluation,
    "loop": run_fit,
}
"""Whose arguments the sections of `identify` are."""


def read(
    *recordings: str | Path | Any,
    test: str | Path | Sequence[str | Path] = (),
    name: str = "files",
    format: str = "auto",
    columns: Mapping[str, str | Sequence[str] | None] | None = None,
    units: Mapping[str, str | None] | None = None,
    sign: Mapping[str, int] = UPRIGHT,
    fields: Mapping[str, Any] | None = None,
    fields_from_name: str | None = None,
    where: Mapping[str, Sequence[Any]] | None = None,
    exclude: Mapping[str, Sequence[Any]] | None = None,
    inputs: Mapping[str, str | float] | None = None,
    payload: Sequence[Any] = (),
    clean: Cleaning = AS_IT_IS,
    simulated: bool = False,
) -> Logs:
    """Recordings as logs in SI units, of any format that `data=files` reads.

    Args:
        recordings: Paths of files, folders, archives, or globs; or recordings in memory: a table of pandas, or a
            mapping from header to samples of shape (time,) or (time, columns).
        test: Paths of recordings that only test.
        name: Of them all.
        format: Name of the files' format; `auto` to go by the file.
        columns: Header or headers of each signal (`time`, `qpos`, `qvel`, `ctrl`, `supply`, `enable`, `temperature`);
            where nothing is said, those that the headers suggest.
        units: Unit of each signal in the recordings; where nothing is said, what headers and numbers suggest.
        sign: 1 or -1 for qpos, qvel and ctrl.
        fields: What is said of all recordings: gains, payload.
        fields_from_name: Regular expression with named groups, which become fields, for the files' names.
        where: Values of fields that are kept.
        exclude: Values of fields that are left out.
        inputs: Signals that the actuator law needs besides the command: a number, or the field that holds it.
        payload: What the drive carried in each recording, as `data.payload` has it.
        clean: How recordings become logs.
        simulated: Whether a simulator made them.

    Returns:
        The logs; what was repaired in each is in its `repairs`, and is shown with them.

    Raises:
        LogError: A recording cannot be read, or does not hold what `columns` names.
        ConfigError: An option is impossible.
    """
    paths = [str(recording) for recording in recordings if isinstance(recording, str | Path)]
    held = [recording for recording in recordings if not isinstance(recording, str | Path)]
    tables = [_to_table(f"recording {number} in memory", recording) for number, recording in enumerate(held, 1)]
    tests = [str(path) for path in ([test] if isinstance(test, str | Path) else test)]
    options = {"format": format, "columns": columns, "units": units, "sign": sign, "fields": fields, "where": where}
    options |= {"fields_from_name": fields_from_name, "exclude": exclude, "inputs": inputs, "payload": payload}
    return Files(name, paths, tests, clean=clean, simulated=simulated, **options).read(tables)


def identify(
    bench: Bench,
    law: str | FrictionModel,
    logs: Logs | Log | Sequence[Log],
    *,
    test: float | Split | None = None,
    method: str | Fit = "auto",
    segments: Cut | None = None,
    loss: Loss | None = None,
    evaluation: Judging | None = None,
    loop: Looping | None = None,
    scale: Mapping[str, float] | None = None,
    seed: int = 0,
    dtype: str = "float32",
    engine: str = "auto",
    device: str = "auto",
    compilation_cache: str | None = "user",
) -> Identified:
    """Find a drive's armature and friction from its logs, as `python -m frictionzoo.run` does.

    Args:
        bench: The test stand.
        law: Name of a friction law, or one of one's own; it stays as it is, the fitted one is the result's.
        logs: Recordings.
        test: Which of them judge the result: the last share of each, or a rule; None as they were read.
        method: Name of a fit, `auto`, `lm`, `adam`, `grid` or `known`, or one with options of its own.
        segments: What the fit compares: `count` windows of `length` samples.
        loss: What the fit minimises: weights of `position` and `velocity`, `robust`, `robust_scale`, `refine`.
        evaluation: The rollouts that judge: `horizons` [s], `rollouts`, `placement`, `trajectory` [s] and others.
        loop: `chunk`, `patience`, `progress`.
        scale: Typical `torque`, `velocity`, `damping` and `inertia` of the drive, of which bounds and initial values of
            a law that is named are multiples; 1 in SI units where nothing is said.
        seed: Of a network's initial weights, for a law that is named.
        dtype: `float32` or `float64`.
        engine: `auto`, `specialised` or `mjx`.
        device: `auto`, `cpu` or `cuda`.
        compilation_cache: Where compiled functions are kept: `user`, a path, or None.

    Returns:
        The drive, with parameters, intervals, errors, figures, exports; nothing is written.

    Raises:
        FrictionzooError: The input is at fault.
    """
    given: dict[str, Any] = {"segments": segments, "loss": loss, "evaluation": evaluation, "loop": loop}
    sizes = {**_scales(), **(scale or {})}
    model = _compose_law(law, bench.nv, {"scale": sizes, "seed": seed}) if isinstance(law, str) else copy.deepcopy(law)
    recordings = (logs if isinstance(logs, Logs) else Logs.of([logs] if isinstance(logs, Log) else logs)).dividing(test)
    fit = METHODS.get(method)() if isinstance(method, str) else method
    settings = {
        **{section: _complete(section, options) for section, options in given.items()},
        **{"seed": seed, "dtype": dtype, "engine": engine, "device": device, "compilation_cache": compilation_cache},
        **{"scale": sizes, "threads": None, "resume": None, "logger": None},
        **{"bench": describe(bench), "data": dict(recordings.section), "fit": describe(fit)},
        "model": {name: value for name, value in describe(model).items() if name != "nv"},
    }
    with computing(dtype, device, compilation_cache) as place:
        problem = Problem.pose(bench, model, recordings.divide(), fit, settings)
        return solve(problem, getattr(model, "name", type(model).__name__), place)


def compare(
    bench: Bench, laws: Sequence[str | FrictionModel], logs: Logs | Log | Sequence[Log], **how: Unpack[How]
) -> Compared:
    """Identify a drive with several laws, each on the same recordings and judged on the same rollouts.

    Args:
        bench: The test stand.
        laws: Names of friction laws, or laws of one's own.
        logs: Recordings.
        how: The options of `identify`.

    Returns:
        The drives, best first, with their paired differences and a recommendation. A law whose fit fails is told among
        its failures.

    Raises:
        FrictionzooError: The input is at fault, or every law failed.
    """
    drives, failures = [], []
    for law in laws:
        name = law if isinstance(law, str) else getattr(law, "name", type(law).__name__)
        try:
            drives.append(identify(bench, law, logs, **how))
        except FrictionzooError as error:
            failures.append(Failure(name, name, str(error)))
    if not drives:
        reasons = "; ".join(f"{failure.model}: {failure.reason}" for failure in failures)
        raise RunError(f"no law has a result to compare: {reasons or 'none was named, expected several'}")
    return Compared.of(drives, failures)


def load(folder: str | Path) -> Identified:
    """A run that has ended, read back from what it left.

    Args:
        folder: Where `result.json` lies.

    Raises:
        RunError: It is not the folder of a finished run of this version, or one of its files is damaged.
        BenchError: The bench's MJCF is not there any more, or not what it was.
    """
    return Identified.load(Path(folder))


def law(name: str, nv: int = 1, *, scale: Mapping[str, float] | None = None, **options: Any) -> FrictionModel:
    """A friction law with the initial values, bounds and options that `conf/model` gives it.

    Args:
        name: Of the law: a file of `conf/model`, or a law of this program that was registered.
        nv: Number of joints.
        scale: As in `identify`.
        options: Of the law, in place of the file's: `law("neural_friction", hidden=[8, 8])`, or of parameters,
            `law("coulomb_smooth", params={"static_torque": {"init": 0.2}})`.

    Returns:
        A `torch.nn.Module`: its parameters are in SI units, those of a network its weights.

    Raises:
        UnknownModelError: No such law.
        ConfigError: No such option, or a value that it cannot have.
    """
    return _compose_law(name, nv, {"scale": scale} if scale else {}, options)


def _compose_law(name: str, nv: int, shared: Mapping[str, Any], options: Mapping[str, Any] | None = None) -> Any:
    if name not in list_choices("model"):
        return get_model(name)(nv, **(options or {}))
    plain = compose_config(f"model={name}")
    changed = copy.deepcopy(plain)
    OmegaConf.set_struct(changed, False)
    changed = cast(DictConfig, OmegaConf.merge(changed, {"model": options or {}, **shared}))
    check_overrides(changed, plain)
    return build(cast(dict[str, Any], OmegaConf.to_container(changed, resolve=True))["model"], nv=nv)


def _scales() -> dict[str, float]:
    """The typical sizes of conf/'s own bench, 1 in SI units."""
    return cast(dict[str, float], OmegaConf.to_container(compose_config()["scale"], resolve=True))


def _complete(section: str, options: Mapping[str, Any] | None) -> dict[str, Any]:
    """A section of the options with what was not said."""
    function = SECTIONS[section]
    defaults = {name: value for name, value in read_defaults(function).items() if name not in ("history", "record")}
    for name in (options or {}).keys() - defaults.keys():
        raise ConfigError(f"{section}.{name}: unknown option; {closest(name, defaults)}")
    return {**defaults, **describe(options or {})}


def _to_table(name: str, recording: Any) -> Table:
    """A recording in memory, a column of several given as one."""
    try:
        held = {str(header): np.asarray(recording[header]) for header in getattr(recording, "columns", recording)}
    except (TypeError, KeyError, IndexError):
        raise LogError(
            f"{name}: {type(recording).__name__}, expected a path, a table, or a mapping from header to samples"
        ) from None
    columns: dict[str, np.ndarray] = {}
    for header, samples in held.items():
        if samples.ndim not in (1, 2) or not np.issubdtype(samples.dtype, np.number):
            raise LogError(
                f"{name}: {header} of shape {samples.shape} and type {samples.dtype}, expected numbers of shape (time,)"
            )
        several = samples.ndim == 2 and samples.shape[1] > 1
        parts = {f"{header}_{i}": part for i, part in enumerate(samples.T)} if several else {header: samples.ravel()}
        columns |= {k: v if v.dtype == np.int64 else v.astype(np.float64) for k, v in parts.items()}
    return Table(name, columns, sha256=digest(columns))
