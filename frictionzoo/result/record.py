"""`result.json`: the machine-readable record of a run, described by `result.schema.json` in this folder."""

import contextlib
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
from jaxtyping import Float

from frictionzoo.bench.base import Bench
from frictionzoo.bench.inertia import SYMBOLS, from_parameters, to_parameters
from frictionzoo.core.errors import RunError
from frictionzoo.core.jobs import read_json, refuse_links, refuse_unfinished
from frictionzoo.core.log import Dataset, Log, pool_origins
from frictionzoo.core.output import RESULT, to_json
from frictionzoo.core.params import Param
from frictionzoo.data.pairing import describe_columns
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.uncertainty import Covariance, Uncertainty
from frictionzoo.models.base import FrictionModel
from frictionzoo.result import types
from frictionzoo.result.card import open_card
from frictionzoo.result.curves import FILE as CURVES
from frictionzoo.result.curves import Curves, read_curves
from frictionzoo.result.evaluate import Evaluation, Judgement, Metrics, Values
from frictionzoo.result.names import label_values
from frictionzoo.result.section_types import CommandRow, GravityRow, InertiaRow
from frictionzoo.result.values import list_values
from frictionzoo.result.verdict import explain_failure, judge
from frictionzoo.simulation.proof import Proof

SCHEMA_VERSION: Final = 10
PACKAGES = ("frictionzoo", "mujoco", "mujoco-mjx", "jax", "torch", "optax", "lightning", "numpy")


def read_schema() -> dict[str, Any]:
    """Read the JSON schema of `result.json`; its descriptions document every field."""
    return json.loads(resources.files("frictionzoo.result").joinpath("result.schema.json").read_text(encoding="utf-8"))


@dataclass(frozen=True, kw_only=True)
class Findings:
    """Inputs and outcome of a run.

    Attributes:
        name: Name of the friction model.
        values: Identified and known values of bench and model.
        judgement: Errors of the identified drive.
        baseline: Errors of the same bench identified without friction, on the same rollouts.
        reference: Values of the bench identified without friction.
        settings: All options of the run, including `seed` and `dtype`.
        recipe: Automatic settings and their values.
        commands: Suggested next commands.
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
    torque: types.TorqueRow | None
    links: LinkInertia | None
    fit: types.FitRow
    timing: types.TimingRow
    settings: Mapping[str, Any]
    engine: str
    proof: Proof
    warnings: Sequence[str]
    device: str
    uncertainty: Uncertainty
    recipe: Sequence[types.ChoiceRow] = ()
    residual: types.ResidualRow | None = None
    commands: Sequence[CommandRow] = ()


def build_result(found: Findings) -> types.Result:
    """Build the record of a run, ready for JSON: no NaN, no numpy types."""
    bench, uncertainty = found.bench, found.uncertainty
    weights = sum(tensor.numel() for name, tensor in found.model.named_parameters() if name not in found.model.params)
    by_horizon: list[types.HorizonRow] = [
        {"horizon": fitted["test"].horizon, **_describe_parts(fitted["train"], fitted["test"], baseline["test"])}
        for fitted, baseline in zip(found.judgement.by_horizon, found.baseline.by_horizon, strict=True)
    ]
    result: types.Result = {
        "schema_version": SCHEMA_VERSION,
        "model": found.name,
        "joints": list(bench.joints),
        "data": describe_data(found.dataset),
        "columns": cast(list[types.ColumnsRow], describe_columns(found.dataset.logs, bench.joints)),
        "parameters": [
            *_list_parameters("bench", bench, bench.params, found.values["bench"], uncertainty),
            *_list_parameters("friction", bench, found.model.params, found.values["friction"], uncertainty),
        ],
        "indistinct": [list(group) for group in uncertainty.indistinct],
        "no_intervals": uncertainty.missing,
        "covariance": _describe_covariance(uncertainty.covariance, bench, found.model),
        "network": {"weights": weights} if weights else None,
        "metrics": _describe_parts(found.judgement.train, found.judgement.test, found.baseline.test),
        "by_horizon": by_horizon,
        "paper": {
            "a": _contrast(found.judgement.trajectory, found.baseline.trajectory),
            "b": _contrast(found.judgement.places, found.baseline.places),
        },
        "by_joint": _list_joints(bench.joints, found.judgement, found.baseline),
        "torque": found.torque,
        "residual": found.residual,
        "links": None if found.links is None else _describe_links(found.links),
        "reference": [
            _describe_value("bench", bench, name, param, found.reference[name], Uncertainty())
            for name, param in bench.params.items()
        ],
        "evaluation": {"sha256": found.evaluation.sha256, "window": found.evaluation.window},
        "fit": found.fit,
        "timing": found.timing,
        "recipe": list(found.recipe),
        "seed": found.settings["seed"],
        "dtype": found.settings["dtype"],
        "engine": cast(types.Simulator, found.engine),
        "proof": cast(types.ProofRow, asdict(found.proof)),
        "warnings": [*found.warnings],
        "notes": list(bench.notes),
        "device": found.device,
        "versions": _read_versions(),
        "card": None,
        "settings": dict(found.settings),
        "written": [],
        "not_identified": None,
        "verdict": {"grade": "nothing speaks against it", "findings": [], "commands": []},
    }
    result["not_identified"] = explain_failure(result)
    plain: Any = to_json(result)
    return plain | {"verdict": judge(plain, found.commands)}


def pick_metrics(result: types.Result) -> dict[str, float]:
    """Return the numbers for the comparison of runs, without those missing due to diverged rollouts.

    The names put errors first: TensorBoard shows only a few, sorted alphabetically with capitals first.
    """
    picked = {
        "MAE/test_position": result["metrics"]["test"]["position_mae"],
        "RMSE/test_position": result["metrics"]["test"]["position_rmse"],
        "MAE/train_position": result["metrics"]["train"]["position_mae"],
        "fit/loss": result["fit"]["loss"],
        "fit/seconds": result["timing"]["fit"],
    }
    for parameter in result["parameters"]:
        values = label_values(parameter)
        picked |= {f"identified/{label}": row["value"] for label, row in values.items() if row["identified"]}
    return {name: value for name, value in picked.items() if value is not None}


def read_run(folder: Path) -> tuple[types.Result, Curves]:
    """Read `result.json` and `curves.safetensors` of a finished run, or of a card, whose curves have no recordings.

    Raises:
        RunError: The folder holds no finished run of this version, or a file is damaged.
    """
    refuse_unfinished(folder)
    refuse_links(folder, files=False)
    result = read_valid(folder / RESULT, SCHEMA_VERSION, read_schema())
    if result["card"]:
        open_card(folder, result)
    curves = read_curves(folder)
    _refuse_inconsistent(folder / RESULT, cast(types.Result, result), curves)
    return cast(types.Result, result), curves


def _refuse_inconsistent(path: Path, result: types.Result, curves: Curves) -> None:
    """Raise RunError if parts of a result name unknown joints, which a schema cannot express."""
    joints = result["joints"]
    named = [(row["joints"], f"parameters: {p['name']}") for p in result["parameters"] for row in p["by_joint"]]
    named += [([row["joint"] for row in result["by_joint"]], "by_joint")]
    wrong = [(names, where) for names, where in named if not names or not {*names} <= {*joints}]
    wrong += [([str(curves.qpos.shape[2])], CURVES)] if curves.qpos.shape[2] != len(joints) else []
    wrong += [(joints, "joints")] if len({*joints}) < len(joints) else []
    for names, where in wrong[:1]:
        raise RunError(
            f"{path}: {where} has {', '.join(names) or 'no joint'}, expected joints among {', '.join(joints)}; name a "
            "run that this program made"
        )


def read_valid(path: Path, version: int, schema: Mapping[str, Any]) -> dict[str, Any]:
    """Read an object from a JSON file of this program and validate its `schema_version` and schema.

    Raises:
        RunError: The file cannot be read or is invalid.
    """
    content = read_json(path)
    if content.get("schema_version") != version:
        saved = content.get("schema_version")
        raise RunError(f"{path}: schema_version {saved}, expected {version}; run it again with this version")
    refuse_invalid(path, content, schema)
    return content


def refuse_invalid(path: Path, content: Mapping[str, Any], schema: Mapping[str, Any]) -> None:
    """Raise RunError with the file's path if an object does not match a schema."""
    errors = jsonschema.Draft202012Validator(schema).iter_errors(content)
    if error := next(iter(errors), None):
        raise RunError(f"{path}: {error.json_path}: {error.message[:200]}; expected the file that this version writes")


def describe_data(dataset: Dataset) -> types.DataRow:
    """Return the section `data`: the recordings, with hashes."""
    hashes = list(dict.fromkeys(log.sha256 for log in dataset.logs))
    joined = hashlib.sha256("\n".join(hashes).encode()).hexdigest()
    return {
        "name": dataset.name,
        "sha256": hashes[0] if len(hashes) == 1 else joined,
        "origin": pool_origins(log.simulated for log in dataset.logs),
        "timestep": round(dataset.logs[0].timestep, 9),
        "samples": sum(log.samples for log in dataset.logs),
        "logs": [_describe_log(log, part) for part in ("train", "test") for log in getattr(dataset, part)],
    }


def _describe_log(log: Log, part: Literal["train", "test"]) -> types.LogRow:
    payload = log.payload and [log.payload.mass, *log.payload.position, *log.payload.inertia]
    return {"name": log.name, "part": part, "samples": log.samples, "sha256": log.sha256, "payload": payload}


def _list_parameters(
    owner: str, bench: Bench, params: Mapping[str, Param], values: Mapping[str, np.ndarray], uncertainty: Uncertainty
) -> list[types.ParameterRow]:
    rows: Any = [
        {
            **_describe_value(owner, bench, name, param, values[name], uncertainty),
            "owner": owner,
            "interval": _interval(uncertainty.intervals.get(f"{owner}.{name}")),
            "identifiable": uncertainty.identifiable.get(f"{owner}.{name}"),
        }
        for name, param in params.items()
    ]
    return rows


def _describe_value(
    owner: str, bench: Bench, name: str, param: Param, value: np.ndarray, uncertainty: Uncertainty
) -> types.ReferenceRow:
    by_joint = list_values(bench, param, f"{owner}.{name}", value, uncertainty)
    return {
        "name": name,
        "owner": "bench",
        "value": _one_or_all(param.spread(np.asarray(value, np.float64), bench.nv).tolist()),
        "unit": param.unit(bench.joint_type),
        "low": _as_given(param, "low", bench.nv),
        "high": _as_given(param, "high", bench.nv),
        "identified": param.is_identified,
        "at_bound": any(row["at_bound"] for row in by_joint),
        "by_joint": by_joint,
    }


def _describe_covariance(
    covariance: Covariance | None, bench: Bench, model: FrictionModel
) -> types.CovarianceRow | None:
    """Return the section `covariance`; None if no parameter has an interval."""
    if covariance is None:
        return None
    params = {"bench": bench.params, "friction": model.params}
    names = [label.partition("/")[0].split(".", 1) for label in covariance.labels]
    return {
        "labels": list(covariance.labels),
        "scale": [params[owner][name].scale for owner, name in names],  # pyright: ignore[reportReturnType]
        "centre": covariance.centre.tolist(),
        "matrix": covariance.matrix.tolist(),
        "freedom": covariance.freedom,
    }


def _describe_links(found: LinkInertia) -> types.LinksRow:
    """Return the section `links`: estimated and model file inertias, and the combinations that the data determine."""
    rows = zip(found.base.describe(), found.values, found.errors, found.determined, strict=True)
    gravity: GravityRow | None = found.tilt and {
        "found": found.tilt.gravity.tolist(),
        "maker": found.tilt.maker.tolist(),
        "angle": found.tilt.angle,
        "error": float(found.tilt.errors.max()),
    }
    return {
        "links": [
            {
                "body": body,
                "found": _describe_inertia(new),
                "maker": _describe_inertia(old),
                "prior_only": [symbol for symbol in SYMBOLS if f"{symbol} {body}" in found.prior_only],
            }
            for body, old, new in zip(found.bodies, found.maker, found.found, strict=True)
        ],
        "gravity": gravity,
        "determined": int(found.determined.sum()),
        "base": [
            {"combination": text, "value": float(value), "error": float(error), "determined": bool(determined)}
            for text, value, error, determined in rows
        ],
    }


def _describe_inertia(parameters: Float[np.ndarray, "10"]) -> InertiaRow:
    mass, centre, inertia = from_parameters(parameters)
    about_centre = to_parameters(mass, np.zeros(3), inertia)[4:]
    return {"mass": mass, "centre": centre.tolist(), "inertia": about_centre.tolist()}


def _list_joints(joints: Sequence[str], judged: Judgement, without: Judgement) -> list[types.JointRow]:
    parts = judged.by_joint["train"], judged.by_joint["test"], without.by_joint["test"]
    return [
        cast(types.JointRow, {"joint": joint, "train": asdict(train), "test": asdict(test), "baseline": asdict(base)})
        for joint, train, test, base in zip(joints, *parts, strict=True)
    ]


def _as_given(param: Param, side: str, nv: int) -> Any:
    """Return one bound for all joints, or a list with one per joint."""
    return param.each(side, nv).tolist() if isinstance(getattr(param, side), tuple) else getattr(param, side)


def _one_or_all(by_joint: list[Any]) -> Any:
    return by_joint if len(by_joint) > 1 else by_joint[0]


def _interval(ends: np.ndarray | None) -> Any:
    """Return the intervals; None if no joint has one."""
    if ends is None or not np.isfinite(ends).any():
        return None
    return _one_or_all([pair.tolist() if np.isfinite(pair).all() else None for pair in ends])


def _describe_parts(train: Metrics, test: Metrics, baseline: Metrics) -> types.PartsRow:
    parts = {"train": train, "test": test, "baseline": baseline}
    return cast(types.PartsRow, {part: asdict(metrics) for part, metrics in parts.items()})


def _contrast(model: Metrics, baseline: Metrics) -> types.ContrastRow:
    return cast(types.ContrastRow, {"model": asdict(model), "baseline": asdict(baseline)})


def _read_versions() -> types.Versions:
    versions = {"python": platform.python_version(), **dict.fromkeys(PACKAGES, "not installed")}
    for package in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return cast(types.Versions, versions)
