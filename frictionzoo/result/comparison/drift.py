"""`drift.json`: whether a drive's parameters have changed since its runs; `drift.schema.json` describes it."""

from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float
from msgspec import Meta

from frictionzoo.core import records
from frictionzoo.core.errors import RunError
from frictionzoo.core.output import complete
from frictionzoo.core.records import Interval, Joints, NotNegative, Record, Text
from frictionzoo.fit.uncertainty import WIDEST
from frictionzoo.result.fitted_drive import FittedDrive
from frictionzoo.result.names import label_values, name_some
from frictionzoo.result.types import Data, Result, Value

read_schema = partial(records.read_schema, "frictionzoo.result.comparison", "drift")
"""Return the JSON schema of `drift.json`, which documents every field."""
SCHEMA_VERSION: Final = 1
Verdict = Literal["unchanged", "changed", "cannot tell"]
Share = Annotated[float, Meta(gt=0, lt=1)]


class ParameterDrift(Record):
    """One parameter of one joint, or of joints that share a value, then and now."""

    name: Text
    """Full name of the parameter: OWNER.NAME."""
    joint: Text
    """Joint, or group of joints that share the value."""
    unit: Text
    """SI unit; 1 for a dimensionless number."""
    then: float
    """Value of the run; for several runs, their mean, geometric if `relative`."""
    now: float | None
    """Value from the new recordings; null: no value was identified."""
    interval_then: Interval | None
    """95 % confidence interval of the first run."""
    interval_now: Interval | None
    """95 % confidence interval from the new recordings; null: none."""
    relative: bool
    """Whether the change is judged relative to the value (`scale: log`), otherwise to the parameter's scale."""
    difference: float | None
    """`now` minus `then`, as estimated from the middles of the intervals; null: not determined now."""
    interval: Interval | None
    """Interval of the difference. The joint confidence level of all these intervals is 1 - `alarm`; null: not
    determined now."""
    spread: NotNegative | None
    """Standard deviation between the runs [unit], including the uncertainty of each; null: one run."""
    verdict: Verdict
    """`cannot tell`: not determined now, or the interval of the difference is too wide, a factor of 1.5."""


class Drift(Record):
    """Comparison of a drive with its finished runs, from new recordings and with the settings of the first run.

    Numbers are in SI units, angles in radians.
    """

    schema_version: Literal[1]
    """Schema version, increased by every change that affects readers of the file."""
    runs: Annotated[list[Text], Meta(min_length=1)]
    """Names of the runs' folders."""
    model: Text
    """Name of the friction model."""
    joints: Joints
    """Names of the identified joints."""
    data: Data | None
    """The new recordings; null: refused because of a definite fault."""
    alarm: Share
    """Probability that an unchanged drive is reported as changed, over all parameters together."""
    smallest: NotNegative
    """Smallest change that counts, as a share of the value or of the parameter's scale."""
    parameters: Annotated[list[ParameterDrift], Meta(min_length=1)]
    """All parameters that the data of the runs determine."""
    untested: list[Text]
    """Identified parameters that the data of a run do not determine, `OWNER.NAME` or `OWNER.NAME/JOINT`."""
    warnings: list[Text]
    """Reasons to doubt the new recordings or their identification."""
    verdict: Verdict
    """Overall verdict: `changed` if any parameter has changed; otherwise `cannot tell` if any is not determined, then
    or now, or if the new recordings or their identification are unusable."""
    summary: Text
    """The verdict in one line."""


class Estimates(NamedTuple):
    """Estimates of coordinates: middles, variances, and degrees of freedom of the variances, which broadcast."""

    centre: Float[np.ndarray, "*shape"]
    variance: Float[np.ndarray, "*shape"]
    freedom: Float[np.ndarray, "*shape"] | float


class Differences(NamedTuple):
    """Changes of new estimates from the mean of earlier ones, half their intervals, and the spread (NaN for one)."""

    mean: Float[np.ndarray, "*shape"]
    change: Float[np.ndarray, "*shape"]
    half: Float[np.ndarray, "*shape"]
    spread: Float[np.ndarray, "*shape"]


def find_differences(earlier: Estimates, now: Estimates, alarm: float) -> Differences:
    """Compare new estimates with earlier ones of the same coordinates, in rows, one row a run.

    change = y - mean,  half = max(t_f sqrt(s^2 + sum_i s_i^2 / n^2),  t_(n-1) sqrt(S^2 (1 + 1 / n) + e))

    with y and s^2 the new estimate and its variance, y_i and s_i^2 those of n runs, f the degrees of freedom of Welch
    and Satterthwaite, S^2 the variance between the y_i, and e the excess of s^2 over the mean of the s_i^2. The first
    half holds for runs that differ only by the uncertainty of the fits. The second one, from two runs on, is half the
    prediction interval of a further run, whatever makes runs differ. A change has to exceed both, so that the
    probability of a false alarm is at most `alarm` for each coordinate.

    Source: B. Welch, "The generalization of 'Student's' problem when several different population variances are
    involved", 1947; F. Satterthwaite, "An approximate distribution of estimates of variance components", 1946.
    """
    n, upper, mean = len(earlier.centre), 1 - alarm / 2, earlier.centre.mean(axis=0)
    own = earlier.variance / n**2
    total = own.sum(axis=0) + now.variance
    squares = (np.square(own) / earlier.freedom).sum(axis=0) + np.square(now.variance) / now.freedom
    degrees = np.divide(np.square(total), squares, out=np.ones_like(total), where=squares > 0)
    half, spread = scipy.special.stdtrit(degrees, upper) * np.sqrt(total), np.full_like(total, np.nan)
    if n > 1:
        spread = earlier.centre.std(axis=0, ddof=1)
        excess = np.maximum(0.0, now.variance - earlier.variance.mean(axis=0))
        further = np.sqrt(np.square(spread) * (1 + 1 / n) + excess)
        half = np.maximum(half, scipy.special.stdtrit(n - 1, upper) * further)
    return Differences(mean, now.centre - mean, half, spread)


def decide(found: Differences, relative: Sequence[bool], smallest: float) -> list[Verdict]:
    """Return the verdict on each coordinate; `relative` says which are logarithms. No verdict for wide intervals."""
    size = np.abs(np.where(relative, np.expm1(found.change), found.change))
    exceeds = (np.abs(found.change) > found.half) & (size > smallest)
    return np.where(exceeds, "changed", np.where(found.half < WIDEST, "unchanged", "cannot tell")).tolist()


def judge_drift(
    runs: Sequence[FittedDrive], now: FittedDrive | None, alarm: float, smallest: float, reason: str = ""
) -> Drift:
    """Return the content of `drift.json` for runs of one drive and a new identification with the same settings.

    `now` is None if the new recordings could not be used, for the `reason`. Each of k parameters is tested with
    `alarm` / k (Bonferroni), so that `alarm` holds for all together.

    Raises:
        RunError: The runs determine no parameter in common.
    """
    first, tables = runs[0].result, [_read(run.result) for run in runs]
    current = _read(now.result) if now else {}
    labels = [label for label, row in _list_values(first).items() if row.identified]
    tested = [label for label in labels if all(label in table for table in tables)]
    if not tested:
        why = next((run.result.no_intervals for run in runs if run.result.no_intervals), None)
        raise RunError(f"{runs[0].place}: {why or 'the runs determine no parameter'}, expected intervals to compare")
    scales = _get_scales(first)
    for run in runs:
        if any(_get_scales(run.result)[label] != scales[label] for label in tested):
            raise RunError(f"{run.place}: its parameters have other scales than in {runs[0].place}; leave it out")
    rows = {label: _describe(runs, now, label, scales[label]) for label in tested}
    if determined := [label for label in tested if label in current]:
        earlier = Estimates(*np.moveaxis(np.array([[table[label] for label in determined] for table in tables]), 2, 0))
        latest = Estimates(*np.transpose([current[label] for label in determined]))
        found = find_differences(earlier, latest, alarm / len(determined))
        verdicts = decide(found, [rows[label].relative for label in determined], smallest)
        for index, label in enumerate(determined):
            change = Differences(*(numbers[index] for numbers in found))
            _put_change(rows[label], change, scales[label], verdicts[index])
    untested = [label for label in labels if label not in tested]
    failure = reason
    if now:
        failed, missing = now.result.not_identified, now.result.no_intervals
        why = f"the drive was not identified: {failed[0]}" if failed else f"no intervals: {missing}" if missing else ""
        failure = now.complaint or why
    verdict, summary = _conclude([*rows.values()], untested, failure)
    return complete(
        Drift(
            schema_version=SCHEMA_VERSION,
            runs=[run.folder.name if run.folder else run.place for run in runs],
            model=first.model,
            joints=first.joints,
            data=now.result.data if now else None,
            alarm=alarm,
            smallest=smallest,
            parameters=[*rows.values()],
            untested=untested,
            warnings=[finding.text for finding in now.result.verdict.findings] if now else [],
            verdict=verdict,
            summary=summary,
        )
    )


def _list_values(result: Result) -> dict[str, Value]:
    return {label: row for parameter in result.parameters for label, row in label_values(parameter).items()}


def _read(result: Result) -> dict[str, tuple[float, float, float]]:
    """Return middle, variance and degrees of freedom of each parameter that the data determine, by label."""
    row, values = result.covariance, _list_values(result)
    return {
        label: (row.centre[index], row.matrix[index][index], row.freedom)
        for index, label in enumerate(row.labels if row else ())
        if row and label in values and values[label].identifiable
    }


def _get_scales(result: Result) -> dict[str, str | float]:
    row = result.covariance
    return dict(zip(row.labels, row.scale, strict=True)) if row else {}


def _describe(runs: Sequence[FittedDrive], now: FittedDrive | None, label: str, scale: str | float) -> ParameterDrift:
    values, name = [_list_values(run.result)[label] for run in runs], label.partition("/")[0]
    current = _list_values(now.result).get(label) if now else None
    numbers = np.array([row.value for row in values])
    mean = np.exp(np.log(numbers).mean()) if isinstance(scale, str) else numbers.mean()
    return ParameterDrift(
        name=name,
        joint=values[0].name,
        unit=next(p.unit for p in runs[0].result.parameters if f"{p.owner}.{p.name}" == name),
        then=float(mean) if len(values) > 1 else values[0].value,
        now=current.value if current else None,
        interval_then=values[0].interval,
        interval_now=current.interval if current else None,
        relative=isinstance(scale, str),
        difference=None,
        interval=None,
        spread=None,
        verdict="cannot tell",
    )


def _put_change(row: ParameterDrift, change: Differences, scale: str | float, verdict: Verdict) -> None:
    """Put a change into a parameter's entry, converted from the coordinate to the parameter's unit."""
    factor = np.exp(change.mean) if isinstance(scale, str) else scale

    def convert(step: Any) -> float:
        return float(factor * (np.expm1(step) if isinstance(scale, str) else step))

    row.verdict, row.difference = verdict, convert(change.change)
    row.interval = [convert(change.change + sign * change.half) for sign in (-1, 1)]
    row.spread = float(factor * change.spread)  # `complete` turns the NaN of a single run into None


def _conclude(rows: Sequence[ParameterDrift], untested: Sequence[str], failed: str) -> tuple[Verdict, str]:
    """Return the overall verdict and its line; `failed` is why the new identification is unusable."""
    if failed:
        for row in rows:
            row.verdict = "cannot tell"
        return "cannot tell", f"cannot tell: {failed}"
    changed = [f"{say_name(row)} {say_change(row)}" for row in rows if row.verdict == "changed"]
    unknown = [row for row in rows if row.verdict == "cannot tell"]
    groups = {
        "the new recordings do not determine": [say_name(row) for row in unknown if row.difference is None],
        "too uncertain": [f"{say_name(row)} {say_change(row)}" for row in unknown if row.difference is not None],
        "the runs do not determine": list(untested),
    }
    doubts = [f"{reason} {name_some(names)}" for reason, names in groups.items() if names]
    if changed:
        return "changed", f"changed: {'; '.join([', '.join(changed), *doubts])}"
    if doubts:
        return "cannot tell", f"cannot tell: {'; '.join(doubts)}"
    # The largest change within the interval, relative to the value.
    widest = max(rows, key=lambda row: max(map(abs, row.interval or [0.0])) / max(abs(row.then), 1e-300))
    count = f"{len(rows)} parameters; the least certain: " if len(rows) > 1 else ""
    return "unchanged", f"unchanged: {count}{say_name(widest)} {say_change(widest)}"


def say_name(row: ParameterDrift) -> str:
    """Return a parameter's name for a sentence: `frictionloss of shaft`."""
    return f"{row.name.partition('.')[2]} of {row.joint}"


def say_change(row: ParameterDrift) -> str:
    """Return a difference with its interval: `+10.3 % [8.9, 11.8]`, or in the unit; `not determined` without one."""
    if row.difference is None or row.interval is None:
        return "not determined"
    factor, unit = (100 / row.then, "%") if row.relative else (1.0, row.unit)
    middle, low, high = (factor * number for number in (row.difference, *row.interval))
    digits = int(np.clip(1 - np.floor(np.log10(max(high - low, 1e-12) / 2)), 0, 9))
    return f"{middle:+.{digits}f} {unit} [{low:.{digits}f}, {high:.{digits}f}]"
