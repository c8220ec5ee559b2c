"""The ten lines of a notebook: read, identify, compare, load, and friction laws by name."""

import contextlib
import copy
import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from frictionzoo.bench import Bench, Robot
from frictionzoo.card.hub import PREFIX, fetch_card
from frictionzoo.card.read import read_card
from frictionzoo.card.record import CARD
from frictionzoo.comparison.compared import Compared
from frictionzoo.comparison.runs import Failure
from frictionzoo.core.build import build
from frictionzoo.core.config import compose_settings, list_choices
from frictionzoo.core.described import describe
from frictionzoo.core.errors import (
    ConfigError,
    FrictionzooError,
    LogError,
    ModelError,
    RunError,
    refuse_unlike,
)
from frictionzoo.core.log import Log
from frictionzoo.core.params import AUTO
from frictionzoo.fit import Fit
from frictionzoo.fit.base import REGISTRY as METHODS
from frictionzoo.identification import Parts, Problem, solve
from frictionzoo.identification.commands import Origin
from frictionzoo.identification.recipe import leave_open, refuse_unknown
from frictionzoo.logs.cache import digest
from frictionzoo.logs.clean import Cleaning
from frictionzoo.logs.files import AS_IT_IS, UPRIGHT, Files
from frictionzoo.logs.logs import Logs
from frictionzoo.logs.recording import Table
from frictionzoo.logs.split import Split
from frictionzoo.models.base import FrictionModel
from frictionzoo.models.by_name import law_section
from frictionzoo.models.registry import get_model
from frictionzoo.result.identified import Identified
from frictionzoo.simulate.context import refuse_late_fork

# Options, as messages name them, that are arguments of another name here; not what looks alike in a file's path.
_DATA = "columns|units|sign|fields|fields_from_name|where|exclude|inputs|payload|clean"
_ARGUMENTS = {
    r"data\.split(\.test_share)?": "test",
    r"data\.train\b(?!\.)": "recordings",
    rf"data\.(?=(test|format)\b(?!\.)|({_DATA})\b)": "",
    r"model\.(?!(xml|mjcf|urdf)\b)": "",
    r"fit\.(?=(derivative|points|start)\b)": "method.",
}


@contextlib.contextmanager
def _naming_arguments() -> Iterator[None]:
    """What an error names as an option of a configuration, it names as an argument of Python."""
    try:
        yield
    except FrictionzooError as error:
        message = str(error)
        for option, argument in _ARGUMENTS.items():
            message = re.sub(rf"(?<![\w./\\-]){option}", argument, message)
        error.args = (message,)
        raise


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
    encoder_step: float
    refine: bool
    continuity: float
    by_joint: bool
    impulse: bool
    slow: float


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
    torque: Mapping[str, float | bool | None]


class Looping(TypedDict, total=False):
    """What happens around the fit, the arguments of `frictionzoo.fit.run_fit`."""

    chunk: int
    patience: int | None
    progress: bool


class How(TypedDict, total=False):
    """The options of `identify`, which describes them."""

    test: float | Split | None
    recipe: str
    method: str | Fit
    segments: Cut
    loss: Loss
    evaluation: Judging
    loop: Looping
    scale: Mapping[str, float]
    checkup: str
    discretisation: bool
    seed: int
    dtype: str | None
    engine: str
    device: str
    compilation_cache: str | None


@_naming_arguments()
def read(
    *recordings: str | Path | Any,
    test: str | Path | Sequence[str | Path] = (),
    name: str = "files",
    format: str = "auto",
    columns: Mapping[str, str | Sequence[str] | None] | None = None,
    units: Mapping[str, str | None] | None = None,
    sign: Mapping[str, int | Sequence[int]] = UPRIGHT,
    fields: Mapping[str, Any] | None = None,
    fields_from_name: str | None = None,
    where: Mapping[str, Sequence[Any]] | None = None,
    exclude: Mapping[str, Sequence[Any]] | None = None,
    inputs: Mapping[str, str | float] | None = None,
    payload: Sequence[Any] = (),
    clean: Cleaning = AS_IT_IS,
    origin: str | None = None,
) -> Logs:
    """Recordings as logs in SI units, of any format that `data=files` reads.

    Args:
        recordings: Paths of files, folders, archives, or globs; or recordings in memory: a table of pandas, or a
            mapping from header to samples of shape (time,) or (time, columns).
        test: Paths of recordings that only test.
        name: Of them all.
        format: Name of the files' format; `auto` to go by the file.
        columns: Header or headers of each signal (`time`, `qpos`, `qvel`, `ctrl`, `ctrl_velocity`, `ctrl_torque`, `kp`,
            `kd`, `torque`, `supply`, `enable`, `temperature`); where nothing is said, those that the headers suggest.
        units: Unit of each signal in the recordings; where nothing is said, what headers and numbers suggest.
        sign: 1 or -1 for qpos, qvel, ctrl, ctrl_velocity, ctrl_torque and torque, or a list of them, one a joint.
        fields: What is said of all recordings: gains, payload.
        fields_from_name: Regular expression with named groups, which become fields, for the files' names.
        where: Values of fields that are kept.
        exclude: Values of fields that are left out.
        inputs: Signals that the actuator law needs besides the command: a number, or the field that holds it.
        payload: What the drive carried in each recording, as `data.payload` has it.
        clean: How recordings become logs.
        origin: `hardware` or `simulated`, where they come from; None: not stated.

    Returns:
        The logs; what was repaired in each is in its `repairs`, and is shown with them.

    Raises:
        LogError: A recording cannot be read, or does not hold what `columns` names.
        ConfigError: An option is impossible.
    """
    if not recordings:
        raise LogError("read: no recording, expected paths, tables or mappings; name one, as in read('a.csv')")
    refuse_unlike("clean", clean, Cleaning, "a Cleaning, as in Cleaning(step=0.002)")
    paths = [str(recording) for recording in recordings if isinstance(recording, str | Path)]
    held = [recording for recording in recordings if not isinstance(recording, str | Path)]
    tables = [_to_table(f"recording {number} in memory", recording) for number, recording in enumerate(held, 1)]
    tests = [str(path) for path in ([test] if isinstance(test, str | Path) else test)]
    options = {"format": format, "columns": columns, "units": units, "sign": sign, "fields": fields, "where": where}
    options |= {"fields_from_name": fields_from_name, "exclude": exclude, "inputs": inputs, "payload": payload}
    return Files(name, paths, tests, clean=clean, origin=origin, **options).read(tables)


@_naming_arguments()
def identify(
    bench: Bench,
    law: str | FrictionModel | Mapping[str, Any],
    logs: Logs | Log | Sequence[Log],
    *,
    test: float | Split | None = None,
    recipe: str = AUTO,
    method: str | Fit = "auto",
    segments: Cut | None = None,
    loss: Loss | None = None,
    evaluation: Judging | None = None,
    loop: Looping | None = None,
    scale: Mapping[str, float] | None = None,
    checkup: str = "strict",
    discretisation: bool = True,
    seed: int = 0,
    dtype: str | None = None,
    engine: str = "auto",
    device: str = "auto",
    compilation_cache: str | None = "user",
) -> Identified:
    """Find a drive's armature and friction from its logs, as `python -m frictionzoo.run` does.

    Args:
        bench: The test stand.
        law: Name of a friction law, or one of one's own; it stays as it is, the fitted one is the result's. Or a law
            for each pattern of joints' names, as `by_joint` takes them.
        logs: Recordings.
        test: Which of them judge the result: the last share of each, or a rule; None as they were read.
        recipe: `auto`: what is not said here or by the bench is found on the training logs, and told with its reason in
            `result["recipe"]`: precision, segments, loss, whether commands act late or the encoder's zero is another,
            and the simulation step. `given`: it is that of the configuration, the paper's, with the step of the MJCF.
        method: Name of a fit, `auto`, `lm`, `adam`, `grid` or `known`, or one with options of its own.
        segments: What the fit compares: `count` windows of `length` samples.
        loss: What the fit minimises: weights of `position` and `velocity`, `robust`, `robust_scale`, `refine`,
            `continuity`, `by_joint`.
        evaluation: The rollouts that judge: `horizons` [s], `rollouts`, `placement`, `trajectory` [s] and others.
        loop: `chunk`, `patience`, `progress`.
        scale: Typical `torque`, `velocity`, `damping` and `inertia` of the drive, of which bounds and initial values of
            a law that is named are multiples; 1 in SI units where nothing is said.
        checkup: `strict`, or `warn`: what is certainly wrong with the recordings, or with the bench for them, is a
            warning of the result and no error.
        discretisation: Whether intervals hold what the simulation's step does, which rollouts of half the step tell.
        seed: Of a network's initial weights, for a law that is named.
        dtype: `float32` or `float64`; None as the recipe has it.
        engine: `auto`, `specialised` or `mjx`.
        device: `auto`, `cpu` or `cuda`.
        compilation_cache: Where compiled functions are kept: `user`, a path, or None.

    Returns:
        The drive, with parameters, intervals, errors, figures, exports; nothing is written.

    Raises:
        FrictionzooError: The input is at fault.
    """
    asked = dict(locals())
    refuse_late_fork()
    refuse_unlike("bench", bench, Bench, "a Bench, as in Bench('stand.xml', actuator=PositionPD(kp=15, kd=0.5))")
    _refuse_unknown(law)
    recordings = _gather(logs).dividing(test)
    fit = METHODS.get(method)() if isinstance(method, str) else method
    refuse_unlike("method", fit, Fit, f"a name, {', '.join(METHODS.names())}, or such an object")
    sections = {"segments": segments, "loss": loss, "evaluation": evaluation, "loop": loop, "scale": scale}
    given: dict[str, Any] = {name: options for name, options in sections.items() if options is not None}
    given |= {"checkup": checkup, "discretisation": discretisation, "seed": seed, "engine": engine, "device": device}
    given["compilation_cache"] = compilation_cache
    given |= {} if dtype is None else {"dtype": dtype}
    refuse_unknown(recipe)
    settings = compose_settings(given, f"recipe={recipe}")
    if isinstance(law, FrictionModel):
        model = law
    else:
        name, options = ("by_joint", {"laws": law}) if isinstance(law, Mapping) else (law, {})
        model = _make_law(name, bench.nv, {k: settings[k] for k in ("scale", "seed")}, options)
        model.bind(bench.joints)
        model.begin(bench.initial_friction(model.params))
    described = {name: value for name, value in describe(model).items() if name != "nv"}
    told = describe(bench)
    settings |= {
        "bench": leave_open(told, settings["bench"], isinstance(bench, Robot)) if recipe == AUTO else told,
        "data": dict(recordings.section),
        "fit": describe(fit),
        "model": described,
    }
    parts = Parts.settle(settings | {"logger": None}, bench, recordings.divide(), copy.deepcopy(model), fit)
    with parts.computing() as place:
        name = law if isinstance(law, str) else model.name
        return solve(Problem.pose(parts), name, place, origin=Origin.of_call(_said(identify, asked)))


@_naming_arguments()
def compare(
    bench: Bench,
    laws: Sequence[str | FrictionModel | Mapping[str, Any]],
    logs: Logs | Log | Sequence[Log],
    **how: Unpack[How],
) -> Compared:
    """Identify a drive with several laws, each on the same recordings and judged on the same rollouts.

    Arguments are those of `identify`, with several laws, by name or of one's own.

    Returns:
        The drives, best first, with their paired differences and a recommendation. A law whose fit fails is told among
        its failures.

    Raises:
        FrictionzooError: The input is at fault, or every law failed.
    """
    if isinstance(laws, str) or not laws:
        raise ConfigError(f"laws={laws!r}; expected several, as in ['baseline', 'coulomb_smooth']")
    for law in laws:
        _refuse_unknown(law)  # before the first fit
    recordings, drives, failures = _gather(logs), [], []
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
    """A run that has ended, or the card of one, read back.

    Args:
        folder: Where the run's `result.json` or the `card.json` lies; or `hub:OWNER/NAME`, a card of a hub of models,
            for which the extra `hub` is needed.

    Returns:
        The drive; that of a card has no recordings, so that what it is to follow has to be given.

    Raises:
        RunError: It is no such folder of this version, or one of its files is damaged.
        BenchError: The MJCF of a run's bench is not there any more, or not what it was.
        ConfigError: The extra is not installed.
    """
    place = fetch_card(folder) if isinstance(folder, str) and folder.startswith(PREFIX) else Path(folder)
    return read_card(place) if (place / CARD).exists() else Identified.load(place)


@_naming_arguments()
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
    return _make_law(name, nv, {"scale": scale} if scale else {}, options)


def _said(function: Callable[..., Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Of a function's arguments by name alone, those that are not as they are where nothing is said."""
    parameters = inspect.signature(function).parameters.values()
    named = [one for one in parameters if one.kind is inspect.Parameter.KEYWORD_ONLY]
    return {one.name: arguments[one.name] for one in named if arguments[one.name] is not one.default}


def _make_law(name: str, nv: int, shared: Mapping[str, Any], options: Mapping[str, Any] | None = None) -> FrictionModel:
    if name not in list_choices("model"):
        return get_model(name)(nv, **(options or {}))
    return build(law_section(name, shared, options or {}), FrictionModel, nv=nv)


def _refuse_unknown(law: str | FrictionModel | Mapping[str, Any]) -> None:
    """Refuse what is no law, or has no name by which a result could be loaded."""
    if isinstance(law, Mapping):  # they are looked at one by one where they are made
        return
    if isinstance(law, str):
        if law not in list_choices("model"):
            get_model(law)
        return
    refuse_unlike("law", law, FrictionModel, "the name of a friction law, or a FrictionModel with its values")
    if not hasattr(law, "name"):
        kind = type(law).__name__
        raise ModelError(f'{kind}: no name, expected a registered law; decorate it @register_model("{kind.lower()}")')


def _gather(logs: Logs | Log | Sequence[Log]) -> Logs:
    return logs if isinstance(logs, Logs) else Logs.of([logs] if isinstance(logs, Log) else logs)


def _to_table(name: str, recording: Any) -> Table:
    """A recording in memory, a column of several given as one."""
    try:
        held = {str(header): np.asarray(recording[header]) for header in getattr(recording, "columns", recording)}
    except (TypeError, KeyError, IndexError):
        kind = type(recording).__name__
        raise LogError(f"{name}: {kind}, expected a path, a table, or a mapping from header to samples") from None
    columns: dict[str, np.ndarray] = {}
    for header, samples in held.items():
        if samples.ndim not in (1, 2) or samples.dtype.kind not in "biuf":
            came = f"{header} of shape {samples.shape} and type {samples.dtype}"
            raise LogError(f"{name}: {came}, expected numbers of shape (time,)")
        several = samples.ndim == 2 and samples.shape[1] > 1
        parts = {f"{header}_{i}": part for i, part in enumerate(samples.T)} if several else {header: samples.ravel()}
        columns |= {k: v if v.dtype == np.int64 else v.astype(np.float64) for k, v in parts.items()}
    return Table(name, columns, sha256=digest(columns))
