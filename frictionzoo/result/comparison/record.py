"""`comparison.json`: comparison of runs; `comparison.schema.json` in this folder describes it."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from itertools import combinations
from typing import Final, Literal

import numpy as np
from jaxtyping import Float

from frictionzoo.core import records
from frictionzoo.core.output import complete
from frictionzoo.result.comparison import types as rows
from frictionzoo.result.comparison.runs import NAMED, Failure, Run, differing
from frictionzoo.result.comparison.statistics import (
    MATTERS,
    Difference,
    autocorrelation,
    bin_evenly,
    difference,
    error_by_horizon,
    find_half_over_seeds,
    mean_of_finite,
    resample,
)
from frictionzoo.result.names import label_values, name_unidentifiable
from frictionzoo.result.types import Result
from frictionzoo.result.verdict import doubt_reference

read_schema = partial(records.read_schema, "frictionzoo.result.comparison", "comparison")
"""Return the JSON schema of `comparison.json`, which documents every field."""
SCHEMA_VERSION: Final = 7
LONGEST_LAG = 0.5  # longest lag of the residuals' autocorrelation [s]
FEW = 8  # number of rollouts below which their interval is unreliable


def compare_runs(runs: Sequence[Run], failures: Sequence[Failure]) -> rows.Comparison:
    """Return the content of `comparison.json` for at least one run, checked by `gather`, and jobs without a result."""
    ranked = sorted(runs, key=_rank)
    counts = resample(len(runs[0].curves.test_mae))
    pairs = {
        (worse.label, better.label): difference(
            *(worse.curves.test_mae, better.curves.test_mae, counts),
            find_half_over_seeds(_list_test_errors(worse), _list_test_errors(better)),
        )
        for better, worse in combinations(ranked, 2)
    }
    result, test = ranked[0].result, ranked[0].result.metrics.test
    reference = next((run for run in ranked if run.result.model == "baseline"), None)
    evaluation = result.evaluation.sha256, test.horizon, test.rollouts
    # Options of the model belong to it.
    options = differing([run.options | {"engine": run.result.engine} for run in ranked], NAMED).items()
    labels = [run.label for run in ranked]
    comparison = rows.Comparison(
        schema_version=SCHEMA_VERSION,
        data=result.data,
        joints=result.joints,
        unit=test.unit,
        velocity_unit=test.velocity_unit,
        torque_unit="N m" if test.unit == "rad" else "N",
        evaluation=rows.CommonRollouts(
            *evaluation, long_rollouts=len(ranked[0].curves.qpos), long_horizon=result.paper.a.model.horizon
        ),
        recommendation=_recommend(ranked, pairs),
        reference=reference.label if reference else None,
        reference_doubt=doubt_reference(reference.result.parameters if reference else result.reference),
        runs=[_describe(run, reference) for run in ranked],
        failures=list(failures),
        differences=[rows.OptionDifference(name, dict(zip(labels, values, strict=True))) for name, values in options],
        pairs=[rows.Pair(*labels, **asdict(pair)) for labels, pair in pairs.items()],
        by_horizon=_by_horizon(ranked),
        by_speed=_by_local(ranked, "local_speed"),
        by_load=_by_local(ranked, "local_load"),
        friction={
            run.label: rows.FrictionCurve(
                c.velocity.tolist(), *(part.T.tolist() for part in (c.friction, c.friction_low, c.friction_high))
            )
            for run in ranked
            for c in [run.curves]
        },
        autocorrelation=_describe_autocorrelation(ranked),
    )
    return complete(comparison)


def _residual(run: Run) -> Float[np.ndarray, "rollouts steps nv"]:
    return run.curves.qpos - run.curves.measured_qpos[:, 1:]


def _list_test_errors(run: Run) -> list[float]:
    errors = [member.result.metrics.test.position_mae for member in run.members]
    return [error for error in errors if error is not None]


def _describe_seeds(run: Run) -> rows.Seeds | None:
    if not run.members:
        return None
    errors = _list_test_errors(run)
    first, *others = ([member.curves.train_mae, member.curves.test_mae] for member in run.members)
    return rows.Seeds(
        values=run.options["seed"],
        runs=[member.folder.name for member in run.members],
        deterministic=all(
            np.array_equal(*pair, equal_nan=True) for each in others for pair in zip(first, each, strict=True)
        ),
        test_std=float(np.std(errors, ddof=1)) if len(errors) > 1 else None,
    )


def _rank(run: Run) -> tuple[int, float, int]:
    test = run.result.metrics.test
    error = np.inf if test.position_mae is None else test.position_mae
    return test.diverged, error, _count_identified(run.result)


def _count_identified(result: Result) -> int:
    values = [value.identified for p in result.parameters for value in p.by_joint]
    return sum(values) + (result.network.weights if result.network else 0)


def _recommend(ranked: Sequence[Run], pairs: Mapping[tuple[str, str], Difference]) -> rows.Recommendation | None:
    """Return the recommended run with reason and doubts; None if all test rollouts diverged."""
    best = ranked[0]
    if best.result.metrics.test.position_mae is None:
        return None
    close = [best, *(run for run in ranked[1:] if pairs[run.label, best.label].verdict == "noise")]
    chosen = min(close, key=lambda run: (_is_doubtful(run.result), _count_identified(run.result), _rank(run)))
    return rows.Recommendation(
        run=chosen.label,
        best=best.label,
        unidentifiable=_list_unidentifiable(chosen.result),
        not_identified=chosen.result.not_identified,
        reason=_explain(chosen, best, close, pairs),
    )


def _list_unidentifiable(result: Result) -> list[str]:
    labelled = [pair for parameter in result.parameters for pair in label_values(parameter).items()]
    return [label for label, row in labelled if row.identifiable is False]


def _is_doubtful(result: Result) -> bool:
    """Return whether the data do not determine all parameters; those of a network are never determined."""
    return bool(_list_unidentifiable(result) or result.network)


def _explain(chosen: Run, best: Run, close: Sequence[Run], pairs: Mapping[tuple[str, str], Difference]) -> str:
    test = chosen.result.metrics.test
    unit, rollouts = test.unit, test.rollouts
    values = _count_identified(chosen.result)
    error = f"Test MAE {test.position_mae:.3g} {unit} with {values} identified value{'s' * (values != 1)}"
    if chosen is not best:
        pair = pairs[chosen.label, best.label]
        lowest, count = best.result.metrics.test.position_mae, _count_identified(best.result)
        text = (
            f"{error}. The lowest error, {lowest:.3g} {unit} of {best.label} with {count}, is within noise of it "
            f"(difference {pair.mean:.2g} {unit}, 95 % interval {pair.low:.2g} to {pair.high:.2g} over {rollouts} "
            f"paired rollouts; below {100 * MATTERS:g} % of the error counts as noise)"
        )
    elif len(close) > 1:
        others = " and ".join(run.label for run in close[1:])
        text = f"{error}, the lowest; {others} {'are' if len(close) > 2 else 'is'} within noise of it"
    else:
        text = f"{error}, the lowest, and all other runs are worse by more than noise over {rollouts} paired rollouts"
    if len(close) > 1:
        simpler = [run.label for run in close if _count_identified(run.result) < values]
        names = ", ".join(simpler)
        text += f". Fewer values, but not all identifiable: {names}" if names else ". No simpler run is within noise"
    if chosen.result.network:
        text += ". It is a network: do not interpret its physical parameters"
    doubtful = name_unidentifiable(chosen.result.parameters)
    doubt = f" Not identifiable, do not interpret these values: {', '.join(doubtful)}." if doubtful else ""
    failed = chosen.result.not_identified
    doubt += f" The drive was not identified: {failed[0]}." if failed else ""
    caution = f" Few rollouts ({rollouts}): raise evaluation.rollouts." if rollouts < FEW else ""
    return f"{text}.{_say_hair(best, pairs)}{doubt}{caution}"


def _say_hair(best: Run, pairs: Mapping[tuple[str, str], Difference]) -> str:
    """Return a sentence on runs whose verdict against the best is a close call; empty for none."""
    close = [(label, pair.verdict) for (label, other), pair in pairs.items() if other == best.label and pair.by_a_hair]
    groups = []
    for verdict, words in (("noise", "within noise"), ("worse", "worse")):
        labels = [label for label, given in close if given == verdict]
        groups += [f"{', '.join(labels)} ({words})"] if labels else []
    return f" Near the limit of noise: {', '.join(groups)}; other rollouts may change this." if groups else ""


def _describe(run: Run, reference: Run | None) -> rows.ComparedRun:
    result = run.result
    return rows.ComparedRun(
        label=run.label,
        run=run.folder.name,
        seeds=_describe_seeds(run),
        model=result.model,
        identified=_count_identified(run.result),
        train=result.metrics.train,
        test=result.metrics.test,
        by_joint=result.by_joint,
        torque=result.torque,
        change=rows.Change(_change(run, reference, "train"), _change(run, reference, "test")),
        rollout_mae=run.curves.test_mae.tolist(),
        by_horizon=[rows.RunHorizon(row.horizon, row.train, row.test) for row in result.by_horizon],
        paper=rows.RunPaper(result.paper.a.model, result.paper.b.model),
        parameters=result.parameters,
        not_identified=result.not_identified,
        network=result.network,
        fit=result.fit,
        settings=rows.Computation(result.seed, result.dtype, result.engine),
        timing=result.timing,
    )


def _change(run: Run, reference: Run | None, part: Literal["train", "test"]) -> float | None:
    """Return the relative change to the reference run's error, or else, on test data only, to the run's baseline's."""
    value = run.result.metrics[part].position_mae
    if reference:
        frictionless = reference.result.metrics[part].position_mae
    else:
        frictionless = run.result.metrics.baseline.position_mae if part == "test" else None
    return value / frictionless - 1 if value is not None and frictionless else None


def _by_horizon(runs: Sequence[Run]) -> rows.ErrorGrowth:
    timestep = runs[0].result.data.timestep
    errors = {run.label: [np.abs(_residual(member)).mean(axis=2) for member in run.by_seed] for run in runs}
    curves = {label: error_by_horizon(np.mean(each, axis=0), timestep) for label, each in errors.items()}
    horizon = next(iter(curves.values()))[0]
    return rows.ErrorGrowth(horizon.tolist(), {label: error.tolist() for label, (_, error) in curves.items()})


def _by_local(runs: Sequence[Run], signal: str) -> rows.BinnedErrors:
    """Return the error of the short rollouts in bins of a measured quantity."""
    measured = getattr(runs[0].curves, signal)
    members = bin_evenly(measured)
    bins = [measured[windows] for windows in members]
    return rows.BinnedErrors(
        centre=[float(inside.mean()) for inside in bins],
        low=[float(inside.min()) for inside in bins],
        high=[float(inside.max()) for inside in bins],
        windows=[len(windows) for windows in members],
        position_mae={run.label: [mean_of_finite(run.curves.local_mae[each]) for each in members] for run in runs},
    )


def _describe_autocorrelation(runs: Sequence[Run]) -> rows.Autocorrelation:
    timestep = runs[0].result.data.timestep
    rollouts, steps, joints = runs[0].curves.qpos.shape
    curves = {}
    for run in runs:
        residual = np.moveaxis(_residual(run), 2, 1).reshape(rollouts * joints, steps)
        lag, curves[run.label] = autocorrelation(residual, timestep, LONGEST_LAG)
    return rows.Autocorrelation(
        lag=lag.round(9).tolist(),  # removes rounding errors of the multiplication
        band=1.96 / np.sqrt(rollouts * joints * steps),
        coefficient={label: curve.tolist() for label, curve in curves.items()},
    )
