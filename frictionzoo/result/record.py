"""`result.json`: the machine-readable record of a run, described by `result.schema.json` in this folder."""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from jaxtyping import Float

from frictionzoo.bench.base import Bench
from frictionzoo.bench.inertia import SYMBOLS, from_parameters, to_parameters
from frictionzoo.core import records
from frictionzoo.core.errors import RunError
from frictionzoo.core.jobs import read_record, refuse_links, refuse_unfinished
from frictionzoo.core.log import Dataset, pool_origins
from frictionzoo.core.output import RESULT, complete
from frictionzoo.core.params import Param
from frictionzoo.data.pairing import describe_columns
from frictionzoo.fit.link_inertia import LinkInertia
from frictionzoo.fit.uncertainty import Uncertainty
from frictionzoo.models.base import FrictionModel
from frictionzoo.result import types
from frictionzoo.result.card import open_card
from frictionzoo.result.curves import FILE as CURVES
from frictionzoo.result.curves import Curves, read_curves
from frictionzoo.result.evaluate import Judgement, Values
from frictionzoo.result.names import label_values
from frictionzoo.result.section_types import BaseParameter, Gravity, Inertia, Link, SuggestedCommand, Verdict
from frictionzoo.result.values import list_values
from frictionzoo.result.verdict import explain_failure, judge

read_schema = partial(records.read_schema, "frictionzoo.result", "result")
"""Return the JSON schema of `result.json`; its descriptions document every field."""
SCHEMA_VERSION: Final = 10
PACKAGES = ("frictionzoo", "mujoco", "mujoco-mjx", "jax", "torch", "optax", "lightning", "numpy")


def build_result(
    *,
    model_name: str,
    bench: Bench,
    model: FrictionModel,
    values: Values,
    dataset: Dataset,
    judgement: Judgement,
    baseline: Judgement,
    reference: Mapping[str, np.ndarray],
    uncertainty: Uncertainty,
    links: LinkInertia | None,
    settings: Mapping[str, Any],
    commands: Sequence[SuggestedCommand] = (),
    **sections: Any,
) -> types.Result:
    """Return the complete record of a run, with its verdict.

    Args:
        model_name: Name of the friction model.
        bench: Identified bench.
        model: Friction model.
        values: Identified and known values of bench and model.
        dataset: Training and test recordings.
        judgement: Errors of the identified drive.
        baseline: Errors of the same bench identified without friction, on the same rollouts.
        reference: Values of the bench identified without friction.
        uncertainty: Intervals of the identified values.
        links: Estimated link inertias; None: none.
        settings: All options of the run, including `seed` and `dtype`.
        commands: Suggested next commands.
        sections: Other fields of `Result`, ready.
    """
    weights = sum(tensor.numel() for name, tensor in model.named_parameters() if name not in model.params)
    parts = (judged.by_joint[part] for judged, part in ((judgement, "train"), (judgement, "test"), (baseline, "test")))
    params, covariance = {"bench": bench.params, "friction": model.params}, None
    if found := uncertainty.covariance:
        names = [label.partition("/")[0].split(".", 1) for label in found.labels]
        scale: Any = [params[owner][name].scale for owner, name in names]
        numbers = found.centre.tolist(), found.matrix.tolist(), found.freedom
        covariance = types.JointUncertainty(list(found.labels), scale, *numbers)
    result = types.Result(
        schema_version=SCHEMA_VERSION,
        model=model_name,
        joints=list(bench.joints),
        data=describe_data(dataset),
        columns=cast(list[types.PairedColumns], describe_columns(dataset.logs, bench.joints)),
        parameters=[
            types.ParameterRecord(
                **_describe_value(owner, bench, name, param, values[owner][name], uncertainty),
                interval=_interval(uncertainty.intervals.get(f"{owner}.{name}")),
                identifiable=uncertainty.identifiable.get(f"{owner}.{name}"),
            )
            for owner, named in params.items()
            for name, param in named.items()
        ],
        indistinct=[list(group) for group in uncertainty.indistinct],
        no_intervals=uncertainty.missing,
        covariance=covariance,
        network=types.Network(weights) if weights else None,
        metrics=types.PartMetrics(judgement.train, judgement.test, baseline.test),
        by_horizon=[
            types.HorizonMetrics(fitted["test"].horizon, fitted["train"], fitted["test"], without["test"])
            for fitted, without in zip(judgement.by_horizon, baseline.by_horizon, strict=True)
        ],
        paper=types.Paper(
            types.Contrast(judgement.trajectory, baseline.trajectory), types.Contrast(judgement.places, baseline.places)
        ),
        by_joint=[types.JointMetrics(joint, *errors) for joint, *errors in zip(bench.joints, *parts, strict=True)],
        links=None if links is None else _describe_links(links),
        reference=[
            types.ReferenceParameter(**_describe_value("bench", bench, name, param, reference[name], Uncertainty()))
            for name, param in bench.params.items()
        ],
        seed=settings["seed"],
        dtype=settings["dtype"],
        notes=list(bench.notes),
        versions=_read_versions(),
        card=None,
        settings=dict(settings),
        written=[],
        not_identified=None,
        verdict=Verdict("no problems found", [], []),
        **sections,
    )
    result = complete(result)
    result.not_identified = explain_failure(result)
    result.verdict = judge(result, commands)
    return result


def pick_metrics(result: types.Result) -> dict[str, float]:
    """Return the numbers for the comparison of runs, without those missing due to diverged rollouts.

    The names put errors first: TensorBoard shows only a few, sorted alphabetically with capitals first.
    """
    picked = {
        "MAE/test_position": result.metrics.test.position_mae,
        "RMSE/test_position": result.metrics.test.position_rmse,
        "MAE/train_position": result.metrics.train.position_mae,
        "fit/loss": result.fit.loss,
        "fit/seconds": result.timing.fit,
    }
    for parameter in result.parameters:
        values = label_values(parameter)
        picked |= {f"identified/{label}": row.value for label, row in values.items() if row.identified}
    return {name: value for name, value in picked.items() if value is not None}


def read_run(folder: Path) -> tuple[types.Result, Curves]:
    """Read `result.json` and `curves.safetensors` of a finished run, or of a card, whose curves have no recordings.

    Raises:
        RunError: The folder holds no finished run of this version, or a file is damaged.
    """
    refuse_unfinished(folder)
    refuse_links(folder, files=False)
    result, curves = read_record(folder / RESULT, types.Result), read_curves(folder)
    if result.card:
        result.settings = open_card(folder, result)
    _refuse_inconsistent(folder / RESULT, result, curves)
    return result, curves


def _refuse_inconsistent(path: Path, result: types.Result, curves: Curves) -> None:
    """Raise RunError for what a schema cannot express: unknown joints, and a reported iteration that was not made."""
    joints = result.joints
    named = [(row.joints, f"parameters: {p.name}") for p in result.parameters for row in p.by_joint]
    named += [([row.joint for row in result.by_joint], "by_joint")]
    wrong = [(names, where) for names, where in named if not names or not {*names} <= {*joints}]
    wrong += [([str(curves.qpos.shape[2])], CURVES)] if curves.qpos.shape[2] != len(joints) else []
    wrong += [(joints, "joints")] if len({*joints}) < len(joints) else []
    for names, where in wrong[:1]:
        raise RunError(
            f"{path}: {where} has {', '.join(names) or 'no joint'}, expected joints among {', '.join(joints)}; name a "
            "run that this program made"
        )
    best, made = result.fit.best_iteration, curves.history.get("iteration")
    if made is not None and best not in made:
        raise RunError(
            f"{path}: fit.best_iteration is {best}, expected one of {CURVES}; name a run that this program made"
        )


def describe_data(dataset: Dataset) -> types.Data:
    """Return the section `data`: the recordings, with hashes."""
    parts: Any = ("train", dataset.train), ("test", dataset.test)
    hashes = list(dict.fromkeys(log.sha256 for log in dataset.logs))
    joined = hashlib.sha256("\n".join(hashes).encode()).hexdigest()
    return types.Data(
        name=dataset.name,
        sha256=hashes[0] if len(hashes) == 1 else joined,
        origin=pool_origins(log.simulated for log in dataset.logs),
        timestep=round(dataset.logs[0].timestep, 9),
        samples=sum(log.samples for log in dataset.logs),
        logs=[
            types.UsedLog(log.name, part, log.samples, log.sha256, load and [load.mass, *load.position, *load.inertia])
            for part, logs in parts
            for log in logs
            for load in [log.payload]
        ],
    )


def _describe_value(
    owner: str, bench: Bench, name: str, param: Param, value: np.ndarray, uncertainty: Uncertainty
) -> dict[str, Any]:
    by_joint = list_values(bench, param, f"{owner}.{name}", value, uncertainty)
    return {
        "name": name,
        "owner": owner,
        "value": _one_or_all(param.spread(np.asarray(value, np.float64), bench.nv).tolist()),
        "unit": param.unit(bench.joint_type),
        "low": _as_given(param, "low", bench.nv),
        "high": _as_given(param, "high", bench.nv),
        "identified": param.is_identified,
        "at_bound": any(row.at_bound for row in by_joint),
        "by_joint": by_joint,
    }


def _describe_links(found: LinkInertia) -> types.Links:
    tilt, prior_only = found.tilt, found.prior_only
    bodies = zip(found.bodies, found.found, found.maker, strict=True)
    numbers = (part.tolist() for part in (found.values, found.errors, found.determined))
    return types.Links(
        links=[
            Link(
                body,
                _describe_inertia(new),
                _describe_inertia(old),
                [s for s in SYMBOLS if f"{s} {body}" in prior_only],
            )
            for body, new, old in bodies
        ],
        gravity=tilt and Gravity(tilt.gravity.tolist(), tilt.maker.tolist(), tilt.angle, float(tilt.errors.max())),
        determined=int(found.determined.sum()),
        base=[BaseParameter(*row) for row in zip(found.base.describe(), *numbers, strict=True)],
    )


def _describe_inertia(parameters: Float[np.ndarray, "10"]) -> Inertia:
    mass, centre, inertia = from_parameters(parameters)
    return Inertia(mass, centre.tolist(), to_parameters(mass, np.zeros(3), inertia)[4:].tolist())


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


def _read_versions() -> types.Versions:
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package.replace("-", "_")] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package.replace("-", "_")] = "not installed"
    return types.Versions(**versions)
