"""`report.html`: one run on one page that works offline, from the verdict to the curves."""

import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import asdict, replace

from frictionzoo.core.anonymous import list_paths_of, without_paths
from frictionzoo.core.jobs import read_begun
from frictionzoo.core.output import to_json
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.report.page import pack_library, save_page
from frictionzoo.report.rollouts import say_where
from frictionzoo.report.run_plots import choose_rollouts, plot_run
from frictionzoo.report.terminal import ERRORS
from frictionzoo.report.text import format_change, format_number, format_share
from frictionzoo.result.curves import Curves
from frictionzoo.result.types import Data, JointErrors, Metrics, ParameterRecord, Result, Timing, Value
from frictionzoo.result.verdict import PURPOSES, doubt_reference, is_usable, judge, list_rollouts, say_finding

TITLES = {
    "identification": "Not identified",
    "recordings": "Recordings",
    "torque": "Recorded torque",
    "gain": "Improvement",
    "joints": "Joints",
    "reference": "Reference",
    "train": "Training and test error",
    "fit": "Fit",
    "bounds": "Bounds",
    "identifiability": "Identifiability",
    "stability": "Stability",
    "residual": "Residual",
}
"""Titles of findings by kind."""
_NEAR, _NAMED = 0.8, 3  # correlation from which a pair is named; largest number of named pairs
MOST, LEAST = 1500, 500  # points per curve for one joint, and at least for several; three figures share a row
METHODS = {"adam": "Adam", "lm": "Levenberg-Marquardt", "grid": "The grid search", "known": "Known values"}
FILES = {  # other files of a run, by path relative to the page
    "result.json": "all numbers of this page, for programs",
    "identified.xml": "the test stand or robot with the identified drive, for MuJoCo",
    "identified.urdf": "the robot with the identified drive",
    "bench.xml": "the simulated part of the robot, for MuJoCo",
    "friction.safetensors": "values or weights of the friction model",
    "figures/figure3_parameters.png": "parameters over iterations, as an image",
    "figures/figure4_trajectory.png": "the trajectory, as an image",
    "figures/figure5_error.png": "its position error, as an image",
    "tensorboard/": "iterations and result, for TensorBoard",
    "csv/": "iterations and result, as tables and text",
    "wandb/": "iterations and result, for Weights & Biases",
    "mlflow/": "iterations and result, for MLflow",
    "checkpoints/": "checkpoints for resuming an interrupted run",
    ".hydra/config.yaml": "the configuration of the run",
}


def write_report(path: Path, result: Result, curves: Curves, replay: Mapping[str, Any] | None = None) -> None:
    """Write the page of a run into the run's folder; the page links to the other files there.

    `replay` comes from `frictionzoo.report.replay.record_replay`; None for a page without a 3D view.

    Raises:
        OutputError: The file cannot be written.
    """
    folder = path.parent
    # A shared page must not reveal anyone's home directory; paths below the working directory become relative.
    place, command = str(folder.absolute()), say_command(folder)
    paths = {place, *list_paths_of(result, command)}
    place, command, result = without_paths([place, command, result], paths, result.joints, Path.cwd())
    result.parameters = [_add_starts(parameter, result.joints, curves) for parameter in result.parameters]
    joints = list_joints(result) if len(result.joints) > 1 else []
    metrics, timestep = result.metrics, result.settings.get("bench", {}).get("timestep")
    *before, last = choose_rollouts(curves)
    save_page(
        path,
        "report/run.html.jinja",
        plot_run(result, curves),
        list(check_result(result)),
        points=max(LEAST, MOST // len(result.joints)),
        state={"replay": replay},
        three=pack_library("three/three.min.js") if replay else "",
        result=result,
        verdict=result.verdict,
        joints=joints,
        place=place,
        uses=list_uses(place, find_target(result)),
        usable=is_usable(result),
        purposes=[PURPOSES[row.kind] for row in result.verdict.commands],
        command=command,
        step=f"{timestep:g} s" if isinstance(timestep, int | float) else "from the model file",
        ranks=f"{', '.join(before)} and {last} test rollout".capitalize() if before else f"The {last} test rollout",
        shown=_say_shown(result, curves),
        correlations=[correlate(result, joint) for joint in result.joints],
        headline=_say_headline(result),
        errors=list(_compare_errors(metrics.test, metrics.baseline, metrics.test)),
        evaluations=list(_list_evaluations(result)),
        timing=list_timing(result.timing),
        files={name: text for name, text in FILES.items() if name == "result.json" or (folder / name).exists()},
        version=result.versions.frictionzoo,
        versions=to_json(result.versions),
    )


def find_target(result: Result) -> str | None:
    """Return the target of the export that the run suggested, None if the drive is not to be used."""
    if not is_usable(result):
        return None
    suggested = [row.command for row in result.verdict.commands if row.kind == "export"]
    named = re.search(r" target=(\w+)$", " ".join(suggested))
    return named[1] if named else "mjcf"


def list_uses(place: str, target: str | None) -> list[str]:
    """Return lines that use the result in a folder, in a shell and in Python; without a target they only read it."""
    export = [f"python -m frictionzoo.export {shlex.quote(place)} target={target}"] if target else []
    use = "drive.parameters, drive.rollout()" if target else "drive.parameters, drive.result.verdict"
    return [*export, "import frictionzoo as fz", f"drive = fz.load({place!r})", use]


def say_command(folder: Path) -> str | None:
    """Return the shell command of the run in a folder, without `resume` and `hydra` options; None if not stored."""
    if not isinstance(overrides := read_begun(folder, "overrides"), list):
        return None
    kept = (text for text in map(str, overrides) if not re.match(r"[+~]*(resume|hydra)\b", text))
    return shlex.join(["python", "-m", "frictionzoo.run", *kept])


class _StartedValue(Value):
    """Value of a parameter with the initial value of the fit."""

    start: float


def _add_starts(parameter: ParameterRecord, joints: list[str], curves: Curves) -> ParameterRecord:
    if (course := curves.history.get(f"{parameter.owner}.{parameter.name}")) is None:
        return parameter
    start = dict(zip(joints, np.ravel(course[0]).tolist(), strict=False))
    rows = [
        _StartedValue(**asdict(row), start=start[row.joints[0]]) if row.identified else row
        for row in parameter.by_joint
    ]
    return replace(parameter, by_joint=rows)


def _say_shown(result: Result, curves: Curves) -> str:
    test, texts = result.metrics.test, []
    for name, rollout in choose_rollouts(curves).items():
        measured = curves.measured_qpos[rollout, 1:]
        errors = (float(np.abs(qpos[rollout] - measured).mean()) for qpos in (curves.qpos, curves.baseline_qpos))
        error, baseline_error = (value if np.isfinite(value) else None for value in errors)
        change = format_change(error, baseline_error)
        about = "; ".join(
            filter(None, (change and f"{change} compared with no friction", say_where(result.data, curves, rollout)))
        )
        texts.append(f"{name} {format_number(error)} {test.unit}" + (f" ({about})" if about else ""))
    count, duration = len(curves.qpos), result.data.timestep * curves.qpos.shape[1]
    suffix = " over joints" if len(result.joints) > 1 else ""
    return (
        f"{count} rollout{'s' * (count > 1)} of {duration:g} s from the test recordings. Mean position error{suffix}: "
        f"{', '.join(texts)}. The error in the headline is the mean over {test.rollouts} "
        f"rollout{'s' * (test.rollouts > 1)} of {test.horizon:g} s."
    )


def correlate(result: Result, joint: str) -> dict[str, Any] | None:
    """Return the correlations of a joint's identified parameters, and the strongest; None below two parameters."""
    if (covariance := result.covariance) is None:
        return None
    labels = covariance.labels
    name_of = {
        label: p.name
        for p in result.parameters
        for row in p.by_joint
        if joint in row.joints
        for label in (f"{p.owner}.{p.name}", f"{p.owner}.{p.name}/{row.name}")
        if label in labels
    }
    if len(name_of) < 2:
        return None
    places = [labels.index(label) for label in name_of]
    matrix = np.array(covariance.matrix)[np.ix_(places, places)]
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    names, rows = [*name_of.values()], np.clip(matrix / np.outer(size, size), -1, 1)
    first, second = np.triu_indices(len(names), 1)
    pairs = sorted(zip(first, second, strict=True), key=lambda pair: -abs(rows[pair]))[:_NAMED]
    strongest = [f"{names[i]} and {names[j]} ({rows[i, j]:.2f})" for i, j in pairs if abs(rows[i, j]) >= _NEAR]
    return {"names": names, "rows": rows.tolist(), "strongest": ", ".join(strongest)}


def check_result(result: Result) -> Iterator[Finding]:
    """Yield the checks of a result: findings first, worst first, then passed checks."""
    doubts = judge(result).findings
    for doubt in doubts:
        text = say_finding(doubt)
        if not set("._/") & set(text.split(maxsplit=1)[0]):  # the first word is no name
            text = text[0].upper() + text[1:]
        yield Finding("bad" if doubt.severe else "caution", TITLES[doubt.kind], f"{text}.")
    kinds = {doubt.kind for doubt in doubts}
    for kind, check in _list_checks(result):
        if kind not in kinds:
            yield check


def _list_checks(result: Result) -> Iterator[tuple[str, Finding]]:
    """Yield kind and check of passed checks; the caller drops kinds that have a finding."""
    yield "gain", _check_gain(result)
    if len(result.joints) > 1 and result.model != "baseline":
        text = f"In each of the {len(result.joints)} joints, the test error is smaller than without friction."
        yield "joints", Finding("good", TITLES["joints"], text)
    yield "held out", check_held_out(result.data)
    train, test = (result.metrics[part].position_mae for part in ("train", "test"))
    ratio = f"{test / train:.2g}" if test is not None and train else "none"
    text = f"The test error, {format_number(test)} {result.metrics.test.unit}, is {ratio} times the training error"
    yield "train", Finding("good", TITLES["train"], f"{text}: no sign of overfitting.")
    yield "fit", _check_fit(result)
    identified = [parameter for parameter in result.parameters if parameter.identified]
    text = f"No parameter ended at a bound ({len(identified)} identified)."
    yield "bounds", Finding("good", TITLES["bounds"], text)
    if result.no_intervals is not None:
        text = f"No parameter has an interval: {result.no_intervals}."
        yield "identifiability", Finding("note", TITLES["identifiability"], text)
    else:
        text = f"The data determine every identified parameter ({len(identified)})."
        yield "identifiability", Finding("good", TITLES["identifiability"], text)
    total = sum(metrics.rollouts for _, metrics in list_rollouts(result))
    text = f"All {total} rollouts stayed finite."
    yield "stability", Finding("good", TITLES["stability"], text)
    yield "residual", _check_residual(result)
    yield "origin", check_origin(result.data)


def _check_gain(result: Result) -> Finding:
    test, baseline = (result.metrics[part].position_mae for part in ("test", "baseline"))
    if result.model == "baseline":
        return Finding("note", TITLES["gain"], "This model has no friction: it is compared with itself.")
    if test is None or not baseline:
        return Finding("note", TITLES["gain"], "The drive without friction has no test error to compare with.")
    text = f"Without friction, the test error is {baseline / test:.3g} times as large"
    if doubt_reference(result.reference):
        return Finding("note", TITLES["gain"], f"{text}; this comparison is unreliable, see the reference.")
    return Finding("good", TITLES["gain"], f"{text}.")


def _check_residual(result: Result) -> Finding:
    residual = result.residual
    rows = residual.by_joint if residual else []
    if not rows:
        text = "The recordings are too short, or the joints move too little, to test whether the residual is noise."
        return Finding("note", TITLES["residual"], text)
    row = max(rows, key=lambda row: row.residual / row.friction)
    share = format_share(row.residual, row.friction)
    joint = f" of {row.joint}" if len(result.joints) > 1 else ""
    text = f"The residual torque, {share} of the friction{joint}, is as large as noise from encoders and filters"
    return Finding("good", TITLES["residual"], f"{text}; no tested factor explains more of it.")


def check_held_out(data: Data) -> Finding:
    """Finding how much held-out data was tested; `data` as in `result.json`."""
    logs = [[log for log in data.logs if log.part == part] for part in ("train", "test")]
    fitted, tested = (data.timestep * sum(log.samples for log in part) for part in logs)
    shared = {log.sha256 for log in logs[0]} & {log.sha256 for log in logs[1]}
    source = "from another part of the same recording" if shared else "from other recordings"
    text = f"Fitted to {fitted:.3g} s of data and tested on {tested:.3g} s {source}."
    return Finding("good", "Held-out data", text)


def _check_fit(result: Result) -> Finding:
    fit = result.fit
    method, count = METHODS.get(fit.method, fit.method), fit.iterations
    iterations = f"{count} iteration{'s' * (count != 1)}"
    reported = f"iteration {fit.best_iteration}, with the lowest training loss, is reported"
    checks = {
        "converged": ("good", f"{method} converged after {iterations}; {reported}."),
        "patience": ("good", f"{method} stopped after {iterations}, when the loss stopped falling; {reported}."),
        "known": ("note", "Nothing was identified: the known values were evaluated."),
        "grid": ("good", f"The grid search tried all {count} combinations; the best is reported."),
    }
    outcome = fit.method if fit.stopped == "finished" else fit.stopped
    state, text = checks.get(outcome, ("good", f"{method} completed {iterations}; {reported}."))
    return Finding(state, TITLES["fit"], text)


def check_origin(data: Data) -> Finding:
    """Finding whether the data come from hardware; `data` as in `result.json`."""
    if data.origin == "simulated":
        text = "The data are simulated: the results show how well the model matches the simulator, not hardware."
        return Finding("note", "Simulated data", text)
    if data.origin == "hardware":
        return Finding("good", "Hardware data", "Recorded on hardware, according to data.origin.")
    return Finding("note", "Origin", "Your recordings. data.origin does not state whether they come from hardware.")


def _say_headline(result: Result) -> str:
    test, baseline = result.metrics.test, result.metrics.baseline
    if test.position_mae is None:
        return f"All {test.rollouts} test rollouts of {test.horizon:g} s diverged: there is no error to report."
    rollouts = f"{test.rollouts} open-loop rollout{'s' * (test.rollouts > 1)} of {test.horizon:g} s"
    text = f"Mean position error {format_number(test.position_mae)} {test.unit} over {rollouts} on test data"
    if not baseline.position_mae or result.model == "baseline":
        return f"{text}."
    change = format_change(test.position_mae, baseline.position_mae)
    without = f"{text}; {format_number(baseline.position_mae)} {test.unit} without friction"
    if doubt_reference(result.reference):
        return f"{without} ({change}, unreliable: a parameter of that fit ended at a bound)."
    return f"{without} ({change})."


def _compare_errors(
    own: Metrics | JointErrors, baseline: Metrics | JointErrors, units: Metrics
) -> Iterator[dict[str, Any]]:
    """Yield rows of a table: errors of the model and without friction."""
    for name, (key, unit) in ERRORS.items():
        if hasattr(own, key):
            yield {"name": name, "unit": units[unit], "model": own[key], "baseline": baseline[key]}


def list_joints(result: Result) -> list[dict[str, Any]]:
    """Return for each joint its errors with and without friction, its parameters, and doubtful values."""
    test = result.metrics.test
    largest = max(result.by_joint, key=lambda row: row.test.position_mae or 0.0)
    residuals = {row.joint: row for row in (result.residual.by_joint if result.residual else [])}
    joints = []
    for row in result.by_joint:
        values = [(p, value) for p in result.parameters for value in p.by_joint if row.joint in value.joints]
        # Values shared by all joints are not a doubt about this joint.
        doubts = [
            f"{p.name} {'at a bound' if value.at_bound else 'not identifiable'}"
            for p, value in values
            if (value.at_bound or value.identifiable is False) and len(value.joints) < len(result.joints)
        ]
        shown = {
            "name": row.joint,
            "residual": residuals.get(row.joint),
            "errors": list(_compare_errors(row.test, row.baseline, test)),
            "parameters": values,
            "open": row is largest,
        }
        joints.append({**shown, "doubt": "; ".join(doubts)})
    return joints


def _list_evaluations(result: Result) -> Iterator[dict[str, Any]]:
    names = {"test": "test, this model", "train": "train, this model", "baseline": "test, no friction"}
    for entry in result.by_horizon:
        yield from ({"on": name, **asdict(entry[part])} for part, name in names.items())
    for key, where in (("a", "one long rollout"), ("b", "random places")):
        for part, name in (("model", "this model"), ("baseline", "no friction")):
            yield {"on": f"{where}, {name}", **asdict(result.paper[key][part])}


def list_timing(timing: Timing) -> dict[str, float]:
    """Return the seconds of each part; the rest of the total comes last."""
    parts: dict[str, Any] = {name: seconds for name, seconds in asdict(timing).items() if name != "total"}
    return parts | {"figures and files": max(0.0, timing.total - sum(parts.values()))}
