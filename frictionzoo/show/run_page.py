"""`report.html`: one run on one page that opens without a network, from the answer down to the curves behind it."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from frictionzoo.core.output import write_atomically
from frictionzoo.result.curves import Curves
from frictionzoo.result.names import name_unidentifiable, name_where, reached_bounds
from frictionzoo.result.types import DataRow, FitRow, ParameterRow, PartsRow, Result, TimingRow, ValueRow
from frictionzoo.result.verdict import doubt_gain, doubt_joints, doubt_reference
from frictionzoo.show.page import Check, render_page
from frictionzoo.show.run_plots import plot_run
from frictionzoo.show.terminal import ERRORS
from frictionzoo.show.text import format_change, format_number, format_unit

OVERFIT = 1.5  # ratio of test to train error from which the page asks for caution
FALLING = 0.01  # share of the loss that the last tenth of the iterations may still take off
METHODS = {"adam": "Adam", "lm": "Levenberg-Marquardt", "grid": "The grid search", "known": "Known values"}
_DIVERGED = "Lower its step or start from other values."
FILES = {  # what else a run leaves behind, by path beside the page
    "result.json": "every number of this page, for programs",
    "identified.xml": "the test stand, or the robot's own file, with the identified drive, for MuJoCo",
    "identified.urdf": "the robot's own file with the identified drive",
    "bench.xml": "what was simulated of the robot, for MuJoCo",
    "friction.safetensors": "the friction law's values or weights",
    "figures/figure3_parameters.png": "parameters over iterations, as an image",
    "figures/figure4_trajectory.png": "the trajectory, as an image",
    "figures/figure5_error.png": "its error, as an image",
    "tensorboard/": "the course of the fit and its result, for TensorBoard",
    "csv/": "the course of the fit and its result, as tables and text",
    "wandb/": "the course of the fit and its result, for Weights & Biases",
    "mlflow/": "the course of the fit and its result, for MLflow",
    "checkpoints/": "what an interrupted run goes on from",
    ".hydra/config.yaml": "the configuration of the run",
}


def write_report(path: Path, result: Result, curves: Curves) -> None:
    """Write the page of a run into this file in the run's folder, to whose other files the page links.

    Raises:
        OutputError: It cannot be written.
    """
    page = render_page(
        "show/run.html.jinja",
        plot_run(result, curves),
        list(check_result(result, curves.history)),
        result=result,
        joints=list_joints(result) if len(result["joints"]) > 1 else [],
        headline=_say_headline(result),
        errors=list(_list_errors(result["metrics"])),
        evaluations=list(_list_evaluations(result)),
        timing=list_timing(result["timing"]),
        files={name: text for name, text in FILES.items() if name == "result.json" or (path.parent / name).exists()},
        version=result["versions"]["frictionzoo"],
    )
    write_atomically(path, page)


def check_result(result: Result, history: Mapping[str, Shaped[np.ndarray, "iterations ..."]]) -> Iterator[Check]:
    """What speaks for the result and what against it; the history has the `loss` of each iteration."""
    if result["not_identified"]:
        why, *reasons = result["not_identified"]
        yield Check("bad", "Not identified", f"This did not identify the drive: {why}. Likely: {'; '.join(reasons)}.")
    for sentence in result["warnings"]:
        yield Check("caution", "Recordings", f"{sentence}.")
    yield _check_gain(result)
    if len(result["joints"]) > 1 and result["model"] != "baseline":
        yield _check_joints(result)
    if doubt := doubt_reference(result["reference"]):
        yield Check("caution", "Reference", f"{doubt[0].upper()}{doubt[1:]}.")
    yield check_held_out(result["data"])
    yield _check_train(result["metrics"])
    yield _check_fit(result["fit"], history["loss"])
    yield _check_bounds(result)
    yield _check_identifiability(result)
    yield _check_divergence(result)
    yield check_origin(result["data"])


def _check_gain(result: Result) -> Check:
    test, baseline = (result["metrics"][part]["position_mae"] for part in ("test", "baseline"))
    if result["model"] == "baseline":
        return Check("note", "Gain", "This model is the drive without friction: it is compared with itself.")
    if test is None:
        return Check("bad", "Gain", "There is no test error: every test rollout diverged.")
    if not baseline:
        return Check("note", "Gain", "The drive without friction has no test error to compare with.")
    if test >= baseline:
        text = "On test data the model is no better than a drive without friction. Do not use its friction."
        return Check("bad", "Gain", text)
    if doubt := doubt_gain(result):
        return Check("caution", "Gain", f"{doubt[0].upper()}{doubt[1:]}.")
    text = f"On test data the model's position error is {baseline / test:.3g} times smaller than without friction."
    return Check("good", "Gain", text)


def _check_joints(result: Result) -> Check:
    if doubt := doubt_joints(result):
        return Check("caution", "Joint by joint", f"{doubt[0].upper()}{doubt[1:]}.")
    text = "On test data the model's position error is smaller than without friction in each of the"
    return Check("good", "Joint by joint", f"{text} {len(result['joints'])} joints.")


def check_held_out(data: DataRow) -> Check:
    """How much was tested that the fit did not see; `data` as in `result.json`."""
    logs = [[log for log in data["logs"] if log["part"] == part] for part in ("train", "test")]
    fitted, tested = (data["timestep"] * sum(log["samples"] for log in part) for part in logs)
    shared = {log["sha256"] for log in logs[0]} & {log["sha256"] for log in logs[1]}
    where = "another stretch of time of the same recording" if shared else "from other recordings"
    text = f"The fit saw {fitted:.3g} s of data and was tested on {tested:.3g} s that it did not see, {where}."
    return Check("good", "Held-out data", text)


def _check_train(metrics: PartsRow) -> Check:
    train, test = (metrics[part]["position_mae"] for part in ("train", "test"))
    if train is None or test is None or train == 0:
        return Check("caution", "Test against train", "Test and training error cannot be compared: one is missing.")
    unit = metrics["test"]["unit"]
    text = f"The test error, {format_number(test)} {unit}, is {test / train:.2g} times that on the training data"
    if test > OVERFIT * train:
        why = "the fit may have learnt its own data by heart, or the test data ask for more"
        return Check("caution", "Test against train", f"{text}: {why}.")
    return Check("good", "Test against train", f"{text}: no sign of overfitting.")


def _check_fit(fit: FitRow, loss: Shaped[np.ndarray, "iterations"]) -> Check:
    method, count = METHODS.get(fit["method"], fit["method"]), fit["iterations"]
    kept = f"iteration {fit['best_iteration']}, that of the lowest training loss, is reported"
    made = f"{method} made all of its {count} iterations"
    said = {
        "converged": ("good", f"{method} converged after {count} iterations; {kept}."),
        "patience": ("good", f"{method} stopped after {count} iterations, as the loss fell no more; {kept}."),
        "diverged": ("bad", f"{method} diverged after {count} iterations; {kept}. {_DIVERGED}"),
        "known": ("note", "Nothing was identified: the given values are judged as they are."),
        "grid": ("good", f"The grid search tried all of its {count} combinations; the best is reported."),
        "lm": ("caution", f"{made} without converging; {kept}. Raise fit.iterations."),
    }
    ended = fit["method"] if fit["stopped"] == "finished" else fit["stopped"]
    if ended in said:
        return Check(said[ended][0], "Fit", said[ended][1])
    if fit["stopped"] != "finished":
        return Check("bad", "Fit", f"{method} was {fit['stopped']} after {count} iterations; {kept}.")
    # The share by which the last tenth of the iterations lowered the lowest loss.
    finite = np.where(np.isfinite(loss), loss, np.inf).astype(np.float64)
    before = finite[: len(finite) - len(finite) // 10].min(initial=np.inf)
    falling = 1 - float(finite.min() / before) if np.isfinite(before) and before > 0 else 0.0
    text, moving = f"{made}; {kept}.", ", ".join(fit["moving"])
    if falling > FALLING:
        text += f" The last tenth still took {100 * falling:.2g} % off the loss: more iterations may find more."
    if moving:
        text += f" Still moving then: {moving}. Raise fit.iterations."
    return Check("caution" if falling > FALLING or moving else "good", "Fit", text)


def _check_bounds(result: Result) -> Check:
    identified = [parameter for parameter in result["parameters"] if parameter["identified"]]
    ended = []
    for p in (p for p in identified if p["at_bound"]):
        low, high = map(format_number, reached_bounds(p))
        ended.append(f"{name_where(p, at_bound=True)} ended at a bound of [{low}, {high}] {format_unit(p['unit'])}")
    if ended:
        return Check("caution", "Bounds", f"{'; '.join(ended)}. Widen the bounds or doubt the model.")
    return Check("good", "Bounds", f"No identified parameter, of {len(identified)}, ended at a bound.")


def _check_identifiability(result: Result) -> Check:
    if result["no_intervals"] is not None:
        return Check("note", "Identifiability", f"No parameter has an interval: {result['no_intervals']}.")
    identified = [parameter for parameter in result["parameters"] if parameter["identified"]]
    doubtful = name_unidentifiable(identified)
    text = [f"Not identifiable on these data: {', '.join(doubtful)}. Do not read a property of the drive into them."]
    text = text if doubtful else [f"The data determine each of the {len(identified)} identified parameters."]
    text += [f"They cannot tell apart {' and '.join(group)}." for group in result["indistinct"]]
    return Check("caution" if doubtful or result["indistinct"] else "good", "Identifiability", " ".join(text))


def _check_divergence(result: Result) -> Check:
    names = {"test": "test", "train": "training", "model": "test", "baseline": "frictionless test"}
    judged = [(names[part], entry[part]) for entry in result["by_horizon"] for part in ("test", "train", "baseline")]
    judged += [(names[part], result["paper"]["a"][part]) for part in ("model", "baseline")]
    lost = [(name, metrics) for name, metrics in judged if metrics["diverged"]]
    if not lost:
        total = sum(metrics["rollouts"] for _, metrics in judged)
        return Check("good", "Stability", f"All {total} rollouts stayed finite and count in the errors.")
    counts = [f"{m['diverged']} of {m['rollouts']} {name} rollouts of {m['horizon']:g} s" for name, m in lost]
    state = "bad" if any(name != names["baseline"] for name, _ in lost) else "caution"
    return Check(state, "Stability", f"Diverged, and left out of the errors: {'; '.join(counts)}.")


def check_origin(data: DataRow) -> Check:
    """Whether the numbers say anything about hardware; `data` as in `result.json`."""
    if data["simulated"]:
        text = "A simulator made these data. The numbers say how well the law imitates it, and nothing about hardware."
        return Check("note", "Simulated data", text)
    return Check("good", "Real data", "The data were recorded on hardware.")


def _say_headline(result: Result) -> str:
    test, baseline = result["metrics"]["test"], result["metrics"]["baseline"]
    if test["position_mae"] is None:
        return f"All {test['rollouts']} test rollouts of {test['horizon']:g} s diverged: there is no error to report."
    rollouts = f"{test['rollouts']} open-loop rollout{'s' * (test['rollouts'] > 1)} of {test['horizon']:g} s"
    text = f"Mean position error {format_number(test['position_mae'])} {test['unit']} over {rollouts} on test data"
    if not baseline["position_mae"] or result["model"] == "baseline":
        return f"{text}."
    change = format_change(test["position_mae"], baseline["position_mae"])
    doubt = ", at a bound" if doubt_reference(result["reference"]) else ""
    return f"{text}; {format_number(baseline['position_mae'])} {test['unit']} without friction{doubt} ({change})."


def _list_errors(metrics: PartsRow) -> Iterator[dict[str, Any]]:
    """Rows of the main table: each error of the model beside that without friction."""
    test, baseline = metrics["test"], metrics["baseline"]
    for name, (key, unit) in ERRORS.items():
        yield {"name": name, "unit": test[unit], "model": test[key], "baseline": baseline[key]}


def list_joints(result: Result) -> list[dict[str, Any]]:
    """Each of several joints: its errors beside those without friction, its parameters, and what is doubtful."""
    test = result["metrics"]["test"]
    largest = max(result["by_joint"], key=lambda row: row["test"]["position_mae"] or 0.0)
    found = []
    for row in result["by_joint"]:
        errors = [
            {"name": name, "unit": test[unit], "model": row["test"][key], "baseline": row["baseline"][key]}
            for name, (key, unit) in ERRORS.items()
            if key in row["test"]
        ]
        values = [
            (p, value) for p in result["parameters"] for value in p["by_joint"] if row["joint"] in value["joints"]
        ]
        # What all joints share is no matter of this one.
        doubts = [_doubt_value(p, value) for p, value in values if len(value["joints"]) < len(result["joints"])]
        shown = {"name": row["joint"], "errors": errors, "parameters": values, "open": row is largest}
        found.append({**shown, "doubt": "; ".join(filter(None, doubts))})
    return found


def _doubt_value(parameter: ParameterRow, value: ValueRow) -> str:
    if value["at_bound"]:
        return f"{parameter['name']} at a bound"
    return f"{parameter['name']} not identifiable" if value["identifiable"] is False else ""


def _list_evaluations(result: Result) -> Iterator[dict[str, Any]]:
    """Rows of the table of all evaluations: the metrics under a name of their rollouts and of the drive."""
    names = {"test": "test, this model", "train": "train, this model", "baseline": "test, no friction"}
    for entry in result["by_horizon"]:
        yield from ({"on": name, **entry[part]} for part, name in names.items())
    for key, where in (("a", "the trajectory above"), ("b", "random places")):
        for part, name in (("model", "this model"), ("baseline", "no friction")):
            yield {"on": f"{where}, {name}", **result["paper"][key][part]}


def list_timing(timing: TimingRow) -> dict[str, float]:
    """Seconds of every part, the rest of the total last."""
    parts: dict[str, Any] = {name: seconds for name, seconds in timing.items() if name != "total"}
    return parts | {"figures and files": max(0.0, timing["total"] - sum(parts.values()))}
