"""Functions for scripts and notebooks: read, identify, compare, load, and friction models by name."""

import contextlib
import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo.api.compared import Compared
from frictionzoo.api.hub import PREFIX, fetch_card
from frictionzoo.api.identified import Identified
from frictionzoo.api.logs import Logs as PlottedLogs
from frictionzoo.bench import Bench, Robot
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_settings, list_choices
from frictionzoo.core.described import describe
from frictionzoo.core.errors import ConfigError, FrictionzooError, LogError, ModelError, RunError, refuse_unlike
from frictionzoo.core.log import Log
from frictionzoo.core.params import AUTO
from frictionzoo.data.cache import digest
from frictionzoo.data.clean import Cleaning
from frictionzoo.data.files import AS_IT_IS, UPRIGHT, Files
from frictionzoo.data.logs import Logs
from frictionzoo.data.recording import Table
from frictionzoo.data.split import Split
from frictionzoo.fit import Fit
from frictionzoo.fit.base import REGISTRY as METHODS
from frictionzoo.identification import Parts, Problem, solve
from frictionzoo.identification.recipe import leave_open, refuse_unknown
from frictionzoo.models.base import FrictionModel
from frictionzoo.models.by_name import law_section
from frictionzoo.models.registry import REGISTRY, get_model
from frictionzoo.result.comparison.runs import Failure
from frictionzoo.simulation.context import refuse_late_fork

# Options in error messages whose Python argument has another name; similar text inside a file path does not match.
_DATA = "columns|units|registers|sign|fields|fields_from_name|where|exclude|inputs|payload|clean"
_ARGUMENTS = {
    r"data\.split(\.test_share)?": "test",
    r"data\.train\b(?!\.)": "recordings",
    rf"data\.(?=(test|format)\b(?!\.)|({_DATA})\b)": "",
    r"model\.(?!(xml|mjcf|urdf)\b)": "",
    r"fit\.(?=(derivative|points|start)\b)": "method.",
}


@contextlib.contextmanager
def _naming_arguments() -> Iterator[None]:
    """Rename configuration options in error messages to Python arguments."""
    try:
        yield
    except FrictionzooError as error:
        message = str(error)
        for option, argument in _ARGUMENTS.items():
            message = re.sub(rf"(?<![\w./\\-]){option}", argument, message)
        error.args = (message,)
        raise


@_naming_arguments()
def read(
    *recordings: str | Path | Any,
    test: str | Path | Mapping[str, str | Path] | Sequence[str | Path | Mapping[str, str | Path]] = (),
    name: str = "files",
    format: str = "auto",
    columns: Mapping[str, str | Sequence[str] | None] | None = None,
    units: Mapping[str, str | None] | None = None,
    registers: str | Mapping[str, Any] | None = None,
    sign: Mapping[str, int | Sequence[int]] = UPRIGHT,
    fields: Mapping[str, Any] | None = None,
    fields_from_name: str | None = None,
    where: Mapping[str, Sequence[Any]] | None = None,
    exclude: Mapping[str, Sequence[Any]] | None = None,
    inputs: Mapping[str, str | float] | None = None,
    payload: Sequence[Any] = (),
    clean: Cleaning = AS_IT_IS,
    origin: str | None = None,
) -> PlottedLogs:
    """Read recordings of any `data=files` format as logs in SI units.

    Args:
        recordings: Paths of files, folders, archives, or globs; a mapping from key to path for several files of one
            recording; or recordings in memory: a pandas table, or a mapping from header to samples of shape (time,) or
            (time, columns).
        test: Paths of recordings for the evaluation only.
        name: Name of the data set.
        format: File format; `auto` detects it.
        columns: Header or headers of each signal (`time`, `qpos`, `qvel`, `ctrl`, `ctrl_velocity`, `ctrl_torque`, `kp`,
            `kd`, `torque`, `supply`, `enable`, `temperature`); by default guessed from the headers.
        units: Unit of each signal in the recordings; by default guessed from headers and numbers.
        registers: Servo series whose raw registers the recordings hold, as in `data.registers`; by default detected.
        sign: 1 or -1 for qpos, qvel, ctrl, ctrl_velocity, ctrl_torque and torque, or a list with one for each joint.
        fields: Values that hold for all recordings, such as gains and payload.
        fields_from_name: Regular expression for file names; its named groups become fields.
        where: Field values of the recordings to keep.
        exclude: Field values of the recordings to leave out.
        inputs: Further inputs of the actuator model: for each a number, or the name of a field with the number.
        payload: Payload of the drive in each recording, as in `data.payload`.
        clean: Rules for cleaning the recordings.
        origin: `hardware` or `simulated`; None: not stated.

    Returns:
        The logs, each with its `repairs`; `plot` draws one.

    Raises:
        LogError: A recording cannot be read, or lacks a column of `columns`.
        ConfigError: An option is invalid.
    """
    if not recordings:
        raise LogError("read: no recording, expected paths, tables or mappings; name one, as in read('a.csv')")
    refuse_unlike("clean", clean, Cleaning, "a Cleaning, as in Cleaning(step=0.002)")
    paths = [describe(recording) for recording in recordings if _is_path(recording)]
    in_memory = [recording for recording in recordings if not _is_path(recording)]
    tables = [_to_table(f"recording {number} in memory", recording) for number, recording in enumerate(in_memory, 1)]
    tests = [describe(path) for path in ([test] if isinstance(test, str | Path | Mapping) else test)]
    options = {"format": format, "columns": columns, "units": units, "registers": registers, "sign": sign}
    options |= {"fields": fields, "where": where}
    options |= {"fields_from_name": fields_from_name, "exclude": exclude, "inputs": inputs, "payload": payload}
    return PlottedLogs.of(Files(name, paths, tests, clean=clean, origin=origin, **options).read(tables))


@_naming_arguments()
def identify(
    bench: Bench,
    law: str | FrictionModel | Mapping[str, Any],
    logs: Logs | Log | Sequence[Log],
    *,
    test: float | Split | None = None,
    recipe: str = AUTO,
    method: str | Fit = "auto",
    segments: Mapping[str, int | None] | None = None,
    loss: Mapping[str, Any] | None = None,
    evaluation: Mapping[str, Any] | None = None,
    loop: Mapping[str, Any] | None = None,
    scale: Mapping[str, float] | None = None,
    checkup: str = "strict",
    discretisation: bool = True,
    seed: int = 0,
    dtype: str | None = None,
    engine: str = "auto",
    device: str = "auto",
    compilation_cache: str | None = "user",
) -> Identified:
    """Identify a drive's armature and friction from its logs, like `python -m frictionzoo.run`; write nothing.

    Args:
        bench: The test stand.
        law: Friction model: a name; a `FrictionModel`, which stays unchanged; or a mapping from patterns of joint names
            to models, as in `by_joint`. The result has the fitted model.
        logs: Recordings.
        test: Recordings for the evaluation: the last share of each, or a rule; None keeps the split of `logs`.
        recipe: `auto` chooses options that neither this call nor the bench sets, from the training logs: precision,
            segments, loss, command delay, position offset and simulation step. `result.recipe` lists them with
            reasons. `given` takes them from the configuration, with the values of the paper, and the step from the
            MJCF.
        method: Name of a fit, such as `auto`, `lm`, `adam`, `grid` or `known`, or a `Fit` with options.
        segments: Segments of the fit: arguments of `frictionzoo.core.segments.cut_segments`.
        loss: Loss of the fit: fields of `frictionzoo.fit.loss.Loss`.
        evaluation: Evaluation rollouts: arguments of `frictionzoo.result.evaluate.Evaluator`.
        loop: Fit loop: arguments of `frictionzoo.fit.run_fit`.
        scale: Typical `torque`, `velocity`, `damping` and `inertia` of the drive, by default 1 in SI units; bounds and
            initial values of a model given by name are multiples of them.
        checkup: `strict`; `warn` turns certain errors in the recordings or the bench into warnings of the result.
        discretisation: Whether confidence intervals include the error of the simulation step, estimated from rollouts
            with half the step.
        seed: Seed of a network's initial weights, for a model given by name.
        dtype: `float32` or `float64`; None: chosen by the recipe.
        engine: `auto`, `specialised` or `mjx`.
        device: `auto`, `cpu` or `cuda`.
        compilation_cache: Cache of compiled functions: `user`, a path, or None.

    Returns:
        The drive with parameters, intervals, errors, figures and exports.

    Raises:
        FrictionzooError: The input is invalid.
    """
    refuse_late_fork()
    refuse_unlike("bench", bench, Bench, "a Bench, as in Bench('stand.xml', actuator=PositionPD(kp=15, kd=0.5))")
    _refuse_unknown(law)
    recordings = Logs.of(logs).dividing(test)
    fit = METHODS.get(method)() if isinstance(method, str) else method
    refuse_unlike("method", fit, Fit, f"a name, {', '.join(METHODS.names())}, or such an object")
    sections = {"segments": segments, "loss": loss, "evaluation": evaluation, "loop": loop, "scale": scale}
    chosen: dict[str, Any] = {name: options for name, options in sections.items() if options is not None}
    chosen |= {"checkup": checkup, "discretisation": discretisation, "seed": seed, "engine": engine, "device": device}
    chosen["compilation_cache"] = compilation_cache
    chosen |= {} if dtype is None else {"dtype": dtype}
    refuse_unknown(recipe)
    settings = compose_settings(chosen, f"recipe={recipe}")
    if isinstance(law, FrictionModel):
        model = law
    else:
        name, options = ("by_joint", {"laws": law}) if isinstance(law, Mapping) else (law, {})
        model = _make_law(name, bench.nv, {k: settings[k] for k in ("scale", "seed")}, options)
        model.bind(bench.joints)
        model.begin(bench.initial_friction(model.params))
    model_section = {name: value for name, value in describe(model).items() if name != "nv"}
    section = describe(bench)
    settings |= {
        "bench": leave_open(section, settings["bench"], isinstance(bench, Robot)) if recipe == AUTO else section,
        "data": dict(recordings.section),
        "fit": describe(fit),
        "model": model_section,
    }
    parts = Parts.settle(settings | {"logger": None}, bench, recordings.divide(), copy.deepcopy(model), fit)
    with parts.computing() as place:
        name = law if isinstance(law, str) else model.name
        return Identified.of(solve(Problem.pose(parts), name, place))


@_naming_arguments()
def compare(
    bench: Bench,
    laws: Sequence[str | FrictionModel | Mapping[str, Any]],
    logs: Logs | Log | Sequence[Log],
    **how: Any,
) -> Compared:
    """Identify a drive with several friction models, on the same recordings and evaluation rollouts.

    The arguments are those of `identify`, with a list of models, by name or as objects.

    Returns:
        The drives, best first, with paired differences, a recommendation, and failed fits.

    Raises:
        FrictionzooError: The input is invalid, or all fits failed.
    """
    if isinstance(laws, str) or not laws:
        raise ConfigError(f"laws={laws!r}; expected several, as in ['baseline', 'coulomb_smooth']")
    for law in laws:
        _refuse_unknown(law)  # before the first fit
    recordings, drives, failures = Logs.of(logs), [], []
    for law in laws:
        try:
            drives.append(identify(bench, law, recordings, **how))
        except FrictionzooError as error:
            name = law if isinstance(law, str) else law.name if isinstance(law, FrictionModel) else "by_joint"
            failures.append(Failure(name, name, str(error)))
    if not drives:
        reasons = dict.fromkeys(failure.reason for failure in failures)
        raise RunError(f"no law has a result to compare: {'; '.join(reasons)}")
    return Compared.of(drives, failures)


def load(folder: str | Path) -> Identified:
    """Load a finished run or a card.

    A drive from a card has no recordings: its rollouts need segments as an argument.

    Args:
        folder: Folder of the run or card; or `hub:OWNER/NAME`, a card of a model hub, which needs the extra `hub`.

    Raises:
        RunError: The folder holds no run or card of this version, or a file is damaged.
        BenchError: The MJCF of the run's bench is missing or has changed.
        ConfigError: The extra is not installed.
    """
    is_on_hub = isinstance(folder, str) and folder.startswith(PREFIX)
    return Identified.load(fetch_card(str(folder)) if is_on_hub else Path(folder))


@_naming_arguments()
def law(name: str, nv: int = 1, *, scale: Mapping[str, float] | None = None, **options: Any) -> FrictionModel:
    """Make a friction model with the initial values, bounds and options that its class declares.

    Args:
        name: A choice of `model=` on the command line, or a registered model.
        nv: Number of joints.
        scale: As in `identify`.
        options: Options of the model, which replace the defaults: `law("neural_friction", hidden=[8, 8])`, or
            `law("coulomb_smooth", params={"static_torque": {"init": 0.2}})`.

    Returns:
        A `torch.nn.Module` whose parameters are in SI units; the parameters of a network are its weights.

    Raises:
        UnknownModelError: There is no such model.
        ConfigError: There is no such option, or its value is invalid.
    """
    return _make_law(name, nv, {"scale": scale} if scale else {}, options)


def list_models() -> list[str]:
    """Return the names of all friction models, those of installed and named plug-in files among them."""
    return sorted({*list_choices("model"), *REGISTRY.names()})


def free(init: Any, low: Any, high: Any, scale: str | float | None = None) -> dict[str, Any]:
    """Return a parameter that a fit identifies, for an argument of a bench, an actuator or a friction model.

    Args:
        init: Initial value, in SI units; a list has one value per joint, a mapping one per pattern of joint names.
        low: Lower bound, likewise.
        high: Upper bound, likewise.
        scale: `log`: steps of the fit are relative to the value; a number: a typical change. By default `log` if the
            lower bound is above 0, otherwise the largest bound.
    """
    low_bound, high_bound = (np.atleast_1d(list(x.values()) if isinstance(x, Mapping) else x) for x in (low, high))
    if scale is None:
        scale = "log" if (low_bound > 0).all() else float(np.abs([low_bound.min(), high_bound.max()]).max())
    return {"init": init, "low": low, "high": high, "scale": scale, "identify": True}


def tied(init: Any, low: Any, high: Any, joints: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return a parameter that a fit identifies with one value for several joints; see `free`.

    Args:
        init: Initial value, in SI units.
        low: Lower bound.
        high: Upper bound.
        joints: Pattern of joint names by group, as in `{"hips": ".*_hip_joint"}`; None: all joints share the value.
    """
    return {**free(init, low, high), "tie": True if joints is None else dict(joints)}


def _make_law(name: str, nv: int, shared: Mapping[str, Any], options: Mapping[str, Any]) -> FrictionModel:
    return build(law_section(name, shared, options), FrictionModel, nv=nv)


def _refuse_unknown(law: str | FrictionModel | Mapping[str, Any]) -> None:
    """Refuse an object that is not a friction model or has no name; a result is loaded by the model's name."""
    if isinstance(law, Mapping):  # each model is checked when it is made
        return
    if isinstance(law, str):
        if law not in list_choices("model"):
            get_model(law)
        return
    refuse_unlike("law", law, FrictionModel, "the name of a friction law, or a FrictionModel with its values")
    if not hasattr(law, "name"):
        kind = type(law).__name__
        raise ModelError(f'{kind}: no name, expected a registered law; decorate it @register_model("{kind.lower()}")')


def _is_path(recording: Any) -> bool:
    """Return whether a recording is a path, or paths by key."""
    paths = [*recording.values()] if isinstance(recording, Mapping) else [recording]
    return all(isinstance(path, str | Path) for path in paths)


def _to_table(name: str, recording: Any) -> Table:
    """Convert a recording in memory to a table; two-dimensional samples become several columns."""
    try:
        arrays = {str(header): np.asarray(recording[header]) for header in getattr(recording, "columns", recording)}
    except (TypeError, KeyError, IndexError):
        kind = type(recording).__name__
        raise LogError(f"{name}: {kind}, expected a path, a table, or a mapping from header to samples") from None
    columns: dict[str, np.ndarray] = {}
    for header, samples in arrays.items():
        if samples.ndim not in (1, 2) or samples.dtype.kind not in "biuf":
            problem = f"{header} of shape {samples.shape} and type {samples.dtype}"
            raise LogError(f"{name}: {problem}, expected numbers of shape (time,)")
        wide = samples.ndim == 2 and samples.shape[1] > 1
        parts = {f"{header}_{i}": part for i, part in enumerate(samples.T)} if wide else {header: samples.ravel()}
        columns |= {k: v if v.dtype == np.int64 else v.astype(np.float64) for k, v in parts.items()}
    return Table(name, columns, sha256=digest(columns))
