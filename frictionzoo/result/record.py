"""`result.json`: the machine-readable record of a run, described by `result.schema.json` beside this file."""

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
from jaxtyping import Shaped

from frictionzoo.bench.base import Bench
from frictionzoo.core.errors import RunError
from frictionzoo.core.log import Dataset, Payload
from frictionzoo.core.output import RESULT, to_json, write_atomically
from frictionzoo.core.params import Param
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.models.base import FrictionModel
from frictionzoo.result.curves import Curves, read_curves
from frictionzoo.result.evaluate import Evaluation, Judgement, Values
from frictionzoo.result.verdict import doubt_sizes, explain_failure, list_moving
from frictionzoo.simulate.proof import Proof

SCHEMA_VERSION = 4
PACKAGES = ("frictionzoo", "mujoco", "mujoco-mjx", "jax", "torch", "optax", "lightning", "numpy")


def read_schema() -> dict[str, Any]:
    """The JSON schema of `result.json`; its descriptions are the documentation of every field."""
    return json.loads(resources.files("frictionzoo.result").joinpath("result.schema.json").read_text(encoding="utf-8"))


def build_result(
    *,
    name: str,
    bench: Bench,
    model: FrictionModel,
    values: Values,
    dataset: Dataset,
    evaluation: Evaluation,
    judgement: Judgement,
    baseline: Judgement,
    reference: Mapping[str, np.ndarray],
    fit: Mapping[str, Any],
    history: Mapping[str, Shaped[np.ndarray, "iterations ..."]],
    timing: Mapping[str, float],
    settings: Mapping[str, Any],
    engine: str,
    proof: Proof,
    warnings: Sequence[str],
    device: str,
    uncertainty: Uncertainty,
) -> dict[str, Any]:
    """The record of a run, ready for JSON: no NaN, no numpy types.

    Args:
        name: The chosen model, as in conf/model.
        bench: The bench that was used.
        model: The friction law.
        values: Identified and known values of both.
        dataset: What was fitted and judged on.
        evaluation: The rollouts on which it was judged.
        judgement: Of the identified drive.
        baseline: Of the same bench identified without friction, on the same rollouts.
        reference: The values of that bench.
        fit: `method`, `iterations`, `best_iteration`, `loss`, `stopped`, as the schema says.
        history: What the fit went through, as `Outcome.history` has it.
        timing: Seconds of `setup`, `compile`, `fit`, `evaluate`, `total`.
        settings: All options of the run, among them `seed` and `dtype`.
        engine: What simulated.
        proof: That it simulates as MuJoCo does.
        warnings: What makes the result doubtful, a sentence each.
        device: Where it ran.
        uncertainty: How far the data determine what was identified.
    """
    # Without friction, inertia makes up for it.
    sizes = [] if name == "baseline" else doubt_sizes(bench.params, values["bench"], bench.joint_type)
    # Iterations of a search are no path, and what converged or diverged says so itself.
    descended = fit["stopped"] == "finished" and fit["method"] != "grid"
    result = {
        "schema_version": SCHEMA_VERSION,
        "model": name,
        "joints": list(bench.joints),
        "data": describe_data(dataset),
        "parameters": [
            *_list_parameters("bench", bench.params, values["bench"], bench.joint_type, uncertainty),
            *_list_parameters("friction", model.params, values["friction"], bench.joint_type, uncertainty),
        ],
        "indistinct": [list(group) for group in uncertainty.indistinct],
        "no_intervals": uncertainty.missing,
        "network": _describe_network(model),
        **_describe_metrics(judgement, baseline),
        "reference": [
            _describe_value("bench", param, name, reference[name], bench.joint_type)
            for name, param in bench.params.items()
        ],
        "evaluation": {"sha256": evaluation.sha256, "window": evaluation.window},
        "fit": dict(fit) | {"moving": list_moving(history, uncertainty.intervals) if descended else []},
        "timing": dict(timing),
        "seed": settings["seed"],
        "dtype": settings["dtype"],
        "engine": engine,
        "proof": asdict(proof),
        "warnings": [*warnings, *sizes],
        "device": device,
        "versions": _read_versions(),
        "settings": dict(settings),
    }
    return to_json(result | {"not_identified": explain_failure(result)})


def pick_metrics(result: Mapping[str, Any]) -> dict[str, float]:
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


def write_result(path: Path, result: Mapping[str, Any]) -> None:
    """Write `result.json`.

    Args:
        path: The file.
        result: From `build_result`.

    Raises:
        OutputError: It cannot be written.
    """
    write_atomically(path, (json.dumps(result, indent=2, allow_nan=False) + "\n").encode())


def read_run(folder: Path) -> tuple[dict[str, Any], Curves]:
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
    return result, read_curves(folder)


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


def describe_data(dataset: Dataset) -> dict[str, Any]:
    """The section `data`: what was read, with hashes.

    Args:
        dataset: Recordings, train and test.
    """
    parts = [(part, log) for part in ("train", "test") for log in getattr(dataset, part)]
    hashes = list(dict.fromkeys(log.sha256 for log in dataset.logs))
    joined = hashlib.sha256("\n".join(hashes).encode()).hexdigest()
    return {
        "name": dataset.name,
        "sha256": hashes[0] if len(hashes) == 1 else joined,
        "simulated": any(log.simulated for log in dataset.logs),
        "timestep": round(dataset.logs[0].timestep, 9),
        "samples": sum(log.samples for log in dataset.logs),
        "logs": [
            {
                "name": log.name,
                "part": part,
                "samples": log.samples,
                "sha256": log.sha256,
                "payload": _flat(log.payload),
            }
            for part, log in parts
        ],
    }


def _flat(payload: Payload | None) -> list[float] | None:
    return None if payload is None else [payload.mass, *payload.position, *payload.inertia]


def _list_parameters(
    owner: str,
    params: Mapping[str, Param],
    values: Mapping[str, np.ndarray],
    joint_type: str,
    uncertainty: Uncertainty,
) -> list[dict[str, Any]]:
    return [
        {
            **_describe_value(owner, param, name, values[name], joint_type),
            "interval": _interval(uncertainty.intervals.get(f"{owner}.{name}")),
            "identifiable": uncertainty.identifiable.get(f"{owner}.{name}"),
        }
        for name, param in params.items()
    ]


def _describe_value(owner: str, param: Param, name: str, value: np.ndarray, joint_type: str) -> dict[str, Any]:
    return {
        "name": name,
        "owner": owner,
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


def _interval(ends: np.ndarray | None) -> list[Any] | None:
    """One joint's interval, or a list of several joints'; None where no joint has one."""
    if ends is None or not np.isfinite(ends).any():
        return None
    by_joint = [pair.tolist() if np.isfinite(pair).all() else None for pair in ends]
    return by_joint if len(by_joint) > 1 else by_joint[0]


def _describe_network(model: FrictionModel) -> dict[str, int] | None:
    weights = sum(tensor.numel() for name, tensor in model.named_parameters() if name not in model.params)
    return {"weights": weights} if weights else None


def _describe_metrics(judgement: Judgement, baseline: Judgement) -> dict[str, Any]:
    by_horizon = [
        {
            "horizon": fitted["test"].horizon,
            "train": asdict(fitted["train"]),
            "test": asdict(fitted["test"]),
            "baseline": asdict(without["test"]),
        }
        for fitted, without in zip(judgement.by_horizon, baseline.by_horizon, strict=True)
    ]
    main = by_horizon[0]
    return {
        "metrics": {part: main[part] for part in ("train", "test", "baseline")},
        "by_horizon": by_horizon,
        "paper": {
            "a": {"model": asdict(judgement.trajectory), "baseline": asdict(baseline.trajectory)},
            "b": {"model": asdict(judgement.places), "baseline": asdict(baseline.places)},
        },
    }


def _read_versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions
