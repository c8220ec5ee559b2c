"""`result.json`: the machine-readable record of a run, described by `result.schema.json` beside this file."""

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata, resources
from pathlib import Path
from typing import Any, Final, Literal, cast

import jsonschema
import numpy as np

from frictionzoo.bench.base import Bench
from frictionzoo.core.errors import RunError
from frictionzoo.core.log import Dataset, Log
from frictionzoo.core.output import RESULT, to_json, write_atomically
from frictionzoo.core.params import Param
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.curves import Curves, read_curves
from frictionzoo.result.evaluate import Evaluation, Judgement, Metrics, Values
from frictionzoo.result.types import (
    ContrastRow,
    DataRow,
    FitRow,
    HorizonRow,
    LogRow,
    MetricsRow,
    NetworkRow,
    PaperRow,
    ParameterRow,
    ProofRow,
    ReferenceRow,
    Result,
    Simulator,
    TimingRow,
    Versions,
)
from frictionzoo.result.verdict import doubt_sizes, explain_failure
from frictionzoo.simulate.proof import Proof

SCHEMA_VERSION: Final = 4
PACKAGES = ("frictionzoo", "mujoco", "mujoco-mjx", "jax", "torch", "optax", "lightning", "numpy")


def read_schema() -> dict[str, Any]:
    """The JSON schema of `result.json`; its descriptions are the documentation of every field."""
    return json.loads(resources.files("frictionzoo.result").joinpath("result.schema.json").read_text(encoding="utf-8"))


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What a run used and found.

    Attributes:
        name: The chosen model, as in conf/model.
        bench: The bench that was used.
        model: The friction law.
        values: Identified and known values of both.
        dataset: What was fitted and judged on.
        evaluation: The rollouts on which it was judged.
        judgement: Of the identified drive.
        baseline: Of the same bench identified without friction, on the same rollouts.
        reference: The values of that bench.
        fit: How they were found.
        timing: Seconds that each part took.
        settings: All options of the run, among them `seed` and `dtype`.
        engine: What simulated.
        proof: That it simulates as MuJoCo does.
        warnings: What makes the result doubtful, a sentence each.
        device: Where it ran.
        uncertainty: How far the data determine what was identified.
    """

    name: str
    bench: Bench
    model: FrictionModel
    values: Values
    dataset: Dataset
    evaluation: Evaluation
    judgement: Judgement
    baseline: Judgement
    reference: Mapping[str, np.ndarray]
    fit: FitRow
    timing: TimingRow
    settings: Mapping[str, Any]
    engine: str
    proof: Proof
    warnings: Sequence[str]
    device: str
    uncertainty: Uncertainty


def build_result(found: Findings) -> Result:
    """The record of a run, ready for JSON: no NaN, no numpy types.

    Args:
        found: What the run used and found.
    """
    bench, joint_type, uncertainty = found.bench, found.bench.joint_type, found.uncertainty
    by_horizon = _list_horizons(found.judgement, found.baseline)
    main = by_horizon[0]
    # Without friction, inertia makes up for it.
    sizes = [] if found.name == "baseline" else doubt_sizes(bench.params, found.values["bench"], joint_type)
    result: Result = {
        "schema_version": SCHEMA_VERSION,
        "model": found.name,
        "joints": list(bench.joints),
        "data": describe_data(found.dataset),
        "parameters": [
            *_list_parameters("bench", bench.params, found.values["bench"], joint_type, uncertainty),
            *_list_parameters("friction", found.model.params, found.values["friction"], joint_type, uncertainty),
        ],
        "indistinct": [list(group) for group in uncertainty.indistinct],
        "no_intervals": uncertainty.missing,
        "network": _describe_network(found.model),
        "metrics": {"train": main["train"], "test": main["test"], "baseline": main["baseline"]},
        "by_horizon": by_horizon,
        "paper": _describe_paper(found.judgement, found.baseline),
        "reference": [
            _describe_value(name, param, found.reference[name], joint_type) for name, param in bench.params.items()
        ],
        "evaluation": {"sha256": found.evaluation.sha256, "window": found.evaluation.window},
        "fit": found.fit,
        "timing": found.timing,
        "seed": found.settings["seed"],
        "dtype": found.settings["dtype"],
        "engine": cast(Simulator, found.engine),
        "proof": cast(ProofRow, asdict(found.proof)),
        "warnings": [*found.warnings, *sizes],
        "device": found.device,
        "versions": _read_versions(),
        "settings": dict(found.settings),
        "not_identified": None,
    }
    return to_json({**result, "not_identified": explain_failure(result)})


def pick_metrics(result: Result) -> dict[str, float]:
    """The numbers by which runs are compared, without those that have no value because rollouts diverged.

    Args:
        result: From `build_result`.
    """
    picked = {
        "test/position_mae": result["metrics"]["test"]["position_mae"],
        "test/position_rmse": result["metrics"]["test"]["position_rmse"],
        "train/position_mae": result["metrics"]["train"]["position_mae"],
        "fit/loss": result["fit"]["loss"],
        "fit/seconds": result["timing"]["fit"],
    }
    for parameter in result["parameters"]:
        if parameter["identified"]:
            name = f"identified/{parameter['owner']}.{parameter['name']}"
            values = parameter["value"]
            several = isinstance(values, list)
            picked |= {f"{name}/{joint}": value for joint, value in enumerate(values)} if several else {name: values}
    return {name: value for name, value in picked.items() if value is not None}


def write_result(path: Path, result: Result) -> None:
    """Write `result.json`.

    Args:
        path: The file.
        result: From `build_result`.

    Raises:
        OutputError: It cannot be written.
    """
    write_atomically(path, (json.dumps(result, indent=2, allow_nan=False) + "\n").encode())


def read_run(folder: Path) -> tuple[Result, Curves]:
    """What a finished run's `result.json` and `curves.safetensors` hold.

    Args:
        folder: The run's folder.

    Raises:
        RunError: It is not the folder of a finished run of this version, or one of the two is damaged.
    """
    path = folder / RESULT
    if not path.exists():
        raise RunError(f"{folder}: no {RESULT} in it, expected the folder of a finished run; name one")
    result = read_json(path)
    if result.get("schema_version") != SCHEMA_VERSION:
        raise RunError(
            f"{path}: schema_version {result.get('schema_version')}, expected {SCHEMA_VERSION}; run it again with this "
            "version"
        )
    error = jsonschema.Draft202012Validator(read_schema()).iter_errors(result)
    if first := next(iter(error), None):
        raise RunError(f"{path}: {first.json_path}: {first.message[:200]}; expected the file that this version writes")
    return cast(Result, result), read_curves(folder)


def read_json(path: Path) -> dict[str, Any]:
    """The object that a JSON file holds.

    Args:
        path: The file.

    Raises:
        RunError: It cannot be read, or holds something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}; expected a file that can be read") from None
    except ValueError as error:
        raise RunError(f"{path}: not JSON ({error}); expected the file that this version writes") from None
    if not isinstance(content, dict):
        raise RunError(f"{path}: {type(content).__name__}, expected an object; name a folder that this program made")
    return content


def describe_data(dataset: Dataset) -> DataRow:
    """The section `data`: what was read, with hashes.

    Args:
        dataset: Recordings, train and test.
    """
    hashes = list(dict.fromkeys(log.sha256 for log in dataset.logs))
    joined = hashlib.sha256("\n".join(hashes).encode()).hexdigest()
    return {
        "name": dataset.name,
        "sha256": hashes[0] if len(hashes) == 1 else joined,
        "simulated": any(log.simulated for log in dataset.logs),
        "timestep": round(dataset.logs[0].timestep, 9),
        "samples": sum(log.samples for log in dataset.logs),
        "logs": [_describe_log(log, part) for part in ("train", "test") for log in getattr(dataset, part)],
    }


def _describe_log(log: Log, part: Literal["train", "test"]) -> LogRow:
    carried = log.payload and [log.payload.mass, *log.payload.position, *log.payload.inertia]
    return {"name": log.name, "part": part, "samples": log.samples, "sha256": log.sha256, "payload": carried}


def _list_parameters(
    owner: Literal["bench", "friction"],
    params: Mapping[str, Param],
    values: Mapping[str, np.ndarray],
    joint_type: str,
    uncertainty: Uncertainty,
) -> list[ParameterRow]:
    return [
        {
            **_describe_value(name, param, values[name], joint_type),
            "owner": owner,
            "interval": _interval(uncertainty.intervals.get(f"{owner}.{name}")),
            "identifiable": uncertainty.identifiable.get(f"{owner}.{name}"),
        }
        for name, param in params.items()
    ]


def _describe_value(name: str, param: Param, value: np.ndarray, joint_type: str) -> ReferenceRow:
    return {
        "name": name,
        "owner": "bench",
        "value": _number_or_list(value),
        "unit": param.unit(joint_type),
        "low": param.low,
        "high": param.high,
        "identified": param.identify,
        "at_bound": param.identify and bool(param.is_at_bound(value).any()),
    }


def _number_or_list(value: np.ndarray) -> float | list[float]:
    """One joint's value as a number, several as a list."""
    flat = np.atleast_1d(np.asarray(value, dtype=np.float64))
    return float(flat[0]) if flat.size == 1 else flat.tolist()


def _interval(ends: np.ndarray | None) -> Any:
    """One joint's interval, or a list of several joints'; None where no joint has one."""
    if ends is None or not np.isfinite(ends).any():
        return None
    by_joint = [pair.tolist() if np.isfinite(pair).all() else None for pair in ends]
    return by_joint if len(by_joint) > 1 else by_joint[0]


def _describe_network(model: FrictionModel) -> NetworkRow | None:
    weights = sum(tensor.numel() for name, tensor in model.named_parameters() if name not in model.params)
    return {"weights": weights} if weights else None


def _list_horizons(judgement: Judgement, baseline: Judgement) -> list[HorizonRow]:
    return [
        {
            "horizon": fitted["test"].horizon,
            "train": _describe_metrics(fitted["train"]),
            "test": _describe_metrics(fitted["test"]),
            "baseline": _describe_metrics(without["test"]),
        }
        for fitted, without in zip(judgement.by_horizon, baseline.by_horizon, strict=True)
    ]


def _describe_paper(judgement: Judgement, baseline: Judgement) -> PaperRow:
    return {
        "a": _contrast(judgement.trajectory, baseline.trajectory),
        "b": _contrast(judgement.places, baseline.places),
    }


def _contrast(model: Metrics, baseline: Metrics) -> ContrastRow:
    return {"model": _describe_metrics(model), "baseline": _describe_metrics(baseline)}


def _describe_metrics(metrics: Metrics) -> MetricsRow:
    return cast(MetricsRow, asdict(metrics))


def _read_versions() -> Versions:
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return cast(Versions, versions)
