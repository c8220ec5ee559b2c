"""Types of `comparison.json`, from which `make docs` generates `comparison.schema.json`."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from frictionzoo.core.records import (
    Count,
    Failure,
    Joints,
    Natural,
    NotNegative,
    Number,
    Positive,
    Record,
    Sha256,
    Simulator,
    Text,
)
from frictionzoo.result.section_types import Torque
from frictionzoo.result.types import Data, FitRecord, JointMetrics, Metrics, Network, ParameterRecord, Timing

Numbers = list[float | None]
Curves = dict[str, Numbers]


class CommonRollouts(Record):
    """The evaluation rollouts, the same for all runs."""

    sha256: Sha256
    """SHA-256 of all measured windows and payloads."""
    horizon: Positive
    """Length of the main rollouts [s]."""
    rollouts: Count
    """Number of main rollouts on test data."""
    long_rollouts: Count
    """Number of long test rollouts, for `by_horizon` and `autocorrelation`."""
    long_horizon: Positive
    """Length of the long test rollouts [s]."""


class Recommendation(Record):
    """The recommended run: among the runs within noise of the best, the one with the fewest identified values.

    Runs whose parameters are all identifiable come first; a network counts as not identifiable.
    """

    run: str
    """Label of the recommended run."""
    best: str
    """Label of the best run: fewest diverged test rollouts, then lowest test error."""
    unidentifiable: list[str]
    """Parameters of the recommended run that its data do not determine: `owner.name`, with several joints
    `owner.name/JOINT`."""
    not_identified: list[Text] | None
    """Reason why the fit did not identify the drive, followed by the likely causes, likeliest first; null: no sign of
    failure."""
    reason: str
    """Reason for the recommendation, in sentences."""


class Change(Record):
    """Error relative to the error without friction, minus 1: -0.64 is a decrease of 64 %."""

    train: float | None
    """Change of the error of `train`; null without a reference run."""
    test: float | None
    """Change of the error of `test`."""


class RunHorizon(Record):
    """Errors of a run's rollouts of one length on each part of the data."""

    horizon: Positive
    """Length of each rollout [s]."""
    train: Metrics
    """Errors on the training logs."""
    test: Metrics
    """Errors on the test logs."""


class RunPaper(Record):
    """The two evaluations of Kovalev et al. (2026), on test data."""

    a: Metrics
    """One long rollout."""
    b: Metrics
    """Rollouts of the main horizon at random places."""


class Computation(Record):
    """Settings of the computation."""

    seed: int
    """Seed of all random numbers in the run."""
    dtype: Number
    """Floating-point type of the simulation."""
    engine: Simulator
    """Simulation engine."""


class Seeds(Record):
    """Runs that differ only in the seed."""

    values: list[int]
    """The seeds."""
    runs: list[str]
    """Names of the runs' folders, lowest training error first."""
    deterministic: bool
    """Whether all seeds give equal errors; the runs count as one."""
    test_std: NotNegative | None
    """Standard deviation of the test error over the seeds [unit]; null: fewer than two seeds have one."""


class ComparedRun(Record):
    """One run, or runs that differ only in the seed.

    With several seeds, errors and times are means over the seeds, and `diverged` counts rollouts that diverged with any
    seed. Everything else is from the run with the lowest training error.
    """

    label: str
    """Name of the run in this file: its model, and its difference from other runs of the same model."""
    run: str
    """Name of the run's folder."""
    seeds: Seeds | None
    """The seeds, if there are several."""
    model: str
    """Name of the friction model."""
    identified: Natural
    """Number of identified values: parameters of each joint or group of joints with a shared value, and network
    weights."""
    train: Metrics
    """Errors of the main rollouts on the training logs."""
    test: Metrics
    """Errors of the main rollouts on the test logs."""
    by_joint: Annotated[list[JointMetrics], Meta(min_length=1)]
    """Errors of each joint in the main rollouts, in the order of `joints`."""
    torque: Torque | None
    """Residual torque of each joint, as in `result.json`; null: not measured."""
    change: Change
    rollout_mae: Numbers
    """Mean absolute position error of each main test rollout [unit], null if it diverged; the rollouts are the same in
    all runs."""
    by_horizon: list[RunHorizon]
    """Errors at every horizon of the evaluation."""
    paper: RunPaper
    parameters: list[ParameterRecord]
    """Physical parameters of bench and friction model. Network weights are in friction.safetensors."""
    not_identified: list[Text] | None
    """Reason why the fit did not identify the drive, followed by the likely causes, likeliest first; null: no sign of
    failure."""
    network: Network | None
    """Trained network of the friction model; null: the model has none."""
    fit: FitRecord
    settings: Computation
    timing: Timing


class OptionDifference(Record):
    """An option that differs between runs."""

    option: str
    """Dotted name of the option."""
    values: dict[str, Any]
    """Value in each run, by label; null: the run has no such option."""


class Pair(Record):
    """Paired bootstrap of two runs over the main test rollouts."""

    run: str
    """Label of the later run in `runs`."""
    other: str
    """Label of the earlier run in `runs`."""
    mean: float | None
    """Error of `run` minus error of `other`, mean over the rollouts [unit]."""
    low: float | None
    """Lower end of the 95 % interval of `mean` [unit]."""
    high: float | None
    """Upper end of the 95 % interval of `mean` [unit]."""
    verdict: Literal["better", "worse", "noise"]
    """Assessment of `run` relative to `other`. If one run has more diverged rollouts, it is worse. Otherwise the
    difference is noise if the interval contains 0 or the mean is below 1 % of the smaller error."""


class ErrorGrowth(Record):
    """Growth of the error: mean over the first seconds of the long test rollouts."""

    horizon: Numbers
    """Horizons [s]."""
    position_mae: Curves
    """Mean error up to each horizon [unit], by label."""


class BinnedErrors(Record):
    """Error in bins of another quantity."""

    centre: Numbers
    """Mean of the quantity in each bin."""
    low: Numbers
    """Smallest value of the quantity in each bin."""
    high: Numbers
    """Largest value of the quantity in each bin."""
    windows: list[Count]
    """Number of short rollouts in each bin."""
    position_mae: Curves
    """Error in each bin [unit], by label."""


class FrictionCurve(Record):
    """Friction torque of a model over velocity."""

    velocity: Numbers
    """Velocities [velocity_unit]."""
    torque: list[Numbers]
    """Friction torque at each velocity [torque_unit], one list for each joint: the median over recorded states."""
    low: list[Numbers]
    """10 % quantile of the friction torque over these states [torque_unit]."""
    high: list[Numbers]
    """90 % quantile of the friction torque over these states [torque_unit]."""


class Autocorrelation(Record):
    """Autocorrelation of the position errors in the long test rollouts: structure that no model has explained."""

    lag: Numbers
    """Lags [s]."""
    band: NotNegative
    """Half width of the 95 % band of unstructured errors around 0."""
    coefficient: Curves
    """Autocorrelation at each lag, mean over the rollouts, by label."""


class Comparison(Record):
    """Comparison of runs on the same data and the same evaluation rollouts, best first.

    Numbers are in SI units, angles in radians. null stands for a number that does not exist, for example if all
    rollouts diverged. Errors are mean absolute position errors in `unit`.
    """

    schema_version: Literal[7]
    """Schema version, increased by every change that affects readers of the file."""
    data: Data
    joints: Joints
    """Names of the identified joints; lists with one entry for each joint have this order."""
    unit: Literal["rad", "m"]
    """Unit of position errors."""
    velocity_unit: Literal["rad/s", "m/s"]
    """Unit of velocities."""
    torque_unit: Literal["N m", "N"]
    """Unit of friction and load."""
    evaluation: CommonRollouts
    recommendation: Recommendation | None
    """The recommended run; null: all test rollouts of all runs diverged."""
    reference: str | None
    """Label of the run without friction to which `change` is relative; null: there is none, and each run's test error
    is relative to its own fit without friction."""
    reference_doubt: str | None
    """Reason why `change` means little: the fit without friction ended at a bound; null: it did not."""
    runs: Annotated[list[ComparedRun], Meta(min_length=1)]
    """The runs: fewest diverged test rollouts first, then lowest test error."""
    failures: list[Failure]
    """Jobs without a result."""
    differences: list[OptionDifference]
    """Options of seed, dtype, engine, segments, loss, fit, bench and teacher that differ between the runs."""
    pairs: list[Pair]
    """Paired bootstrap of every pair of runs over the main test rollouts."""
    by_horizon: ErrorGrowth
    by_speed: BinnedErrors
    """Error of short test rollouts in bins of the mean absolute measured velocity [velocity_unit]."""
    by_load: BinnedErrors
    """Error of short test rollouts in bins of the mean absolute motor torque [torque_unit]."""
    friction: dict[str, FrictionCurve]
    """Friction torque over velocity, by label."""
    autocorrelation: Autocorrelation
