"""What `comparison.json` holds, as types, from which `make docs` makes `comparison.schema.json`."""

from typing import Annotated, Any, Literal, TypedDict

from frictionzoo.result.kinds import Count, Joints, Natural, NotNegative, Number, Positive, Sha256, Simulator, Text
from frictionzoo.result.torque_types import TorqueRow
from frictionzoo.result.types import DataRow, FitRow, JointRow, MetricsRow, NetworkRow, ParameterRow, TimingRow

Numbers = list[float | None]
Curves = dict[str, Numbers]


class RolloutsRow(TypedDict):
    """The rollouts on which all runs were judged."""

    sha256: Sha256
    """Hash of all measured windows."""
    horizon: Positive
    """Length of the main rollouts [s]."""
    rollouts: Count
    """How many of them, on test data."""
    long_rollouts: Count
    """How many long test rollouts, for `by_horizon` and `autocorrelation`."""
    long_horizon: Positive
    """Their length [s]."""


class RecommendationRow(TypedDict):
    """The simplest run within noise of the best."""

    run: str
    """Label of the run to take."""
    best: str
    """Label of the run with the lowest test error."""
    unidentifiable: list[str]
    """Parameters of the run to take that its data do not determine, as `owner.name`, of several joints
    `owner.name/JOINT`."""
    not_identified: list[Text] | None
    """Null, or that the fit did not identify the drive: why that is said, and the likely reasons, the likeliest
    first."""
    reason: str
    """Why, in sentences."""


class ChangeRow(TypedDict):
    """Error relative to no friction, minus 1: -0.64 is 64 % less."""

    train: float | None
    """On `train`; null without a reference run."""
    test: float | None
    """On `test`."""


class RunHorizonRow(TypedDict):
    """Errors of a run's rollouts of one length on each part of the data."""

    horizon: Positive
    """Length of each rollout [s]."""
    train: MetricsRow
    """On the logs that the fit saw."""
    test: MetricsRow
    """On the logs that it did not see."""


class RunPaperRow(TypedDict):
    """The two evaluations of Kovalev et al. (2026), on test data."""

    a: MetricsRow
    """One long rollout."""
    b: MetricsRow
    """Rollouts of the main horizon at random places."""


class SettingsRow(TypedDict):
    """How it was run."""

    seed: int
    """Seed of everything random in the run."""
    dtype: Number
    """Number type of the simulation."""
    engine: Simulator
    """What simulated."""


class RunRow(TypedDict):
    """One run."""

    label: str
    """Its name in this file: the model, and what distinguishes it from other runs of that model."""
    run: str
    """Name of its folder."""
    model: str
    """The chosen model, a file of conf/model."""
    identified: Natural
    """How many numbers the fit chose: parameters, for each joint or group of joints that share them, and a network's
    weights."""
    train: MetricsRow
    """Main rollouts on the logs that the fit saw."""
    test: MetricsRow
    """Main rollouts on the logs that it did not see."""
    by_joint: Annotated[list[JointRow], ("minItems", 1)]
    """Errors of each joint in the main rollouts, in the order of `joints`."""
    torque: TorqueRow | None
    """What is left of recorded torque joint by joint, as in `result.json`; null where that was not measured."""
    change: ChangeRow
    rollout_mae: Numbers
    """Error of each main test rollout; the runs' entries belong together in pairs."""
    by_horizon: list[RunHorizonRow]
    """The metrics at every horizon of the evaluation."""
    paper: RunPaperRow
    parameters: list[ParameterRow]
    """Physical parameters of bench and friction law. A network's weights are in friction.safetensors."""
    not_identified: list[Text] | None
    """Null, or that the fit did not identify the drive: why that is said, and the likely reasons, the likeliest
    first."""
    network: NetworkRow | None
    """The law's trained network; null for a law without one."""
    fit: FitRow
    settings: SettingsRow
    timing: TimingRow


class FailureRow(TypedDict):
    """A job without a result."""

    run: str
    """Name of its folder."""
    model: str
    """The chosen model; empty where that is not known."""
    reason: str
    """Why, in one line."""


class DifferenceRow(TypedDict):
    """An option in which the runs differ."""

    option: str
    """Dotted name."""
    values: dict[str, Any]
    """Value of each run, by label; null where it has none."""


class PairRow(TypedDict):
    """Two runs, by a paired bootstrap over the main test rollouts."""

    run: str
    """Label of the one that comes later in `runs`."""
    other: str
    """Label of the one that comes earlier."""
    mean: float | None
    """Error of `run` minus error of `other`, mean over rollouts."""
    low: float | None
    """Lower end of its 95 % interval."""
    high: float | None
    """Upper end."""
    verdict: Literal["better", "worse", "noise"]
    """What `run` is, seen from `other`; noise: the interval holds 0, or the mean is below 1 % of the smaller error and
    does not matter. Where one diverged more often, that decides."""


class GrowthRow(TypedDict):
    """How the error grows: mean over the first seconds of the long test rollouts."""

    horizon: Numbers
    """Horizons [s]."""
    position_mae: Curves
    """Error at each horizon, by label."""


class BinnedRow(TypedDict):
    """An error in bins of another quantity."""

    centre: Numbers
    """Mean of each bin."""
    low: Numbers
    """Its smallest value."""
    high: Numbers
    """Its largest value."""
    windows: list[Count]
    """Short rollouts in it."""
    position_mae: Curves
    """Error in each bin, by label."""


class FrictionRow(TypedDict):
    """A law's friction torque over velocity."""

    velocity: Numbers
    """Velocities, in `velocity_unit`."""
    torque: list[Numbers]
    """Friction torque at them, in `torque_unit`, a list a joint; the median over recorded states."""
    low: list[Numbers]
    """Its lower decile over these states."""
    high: list[Numbers]
    """Its upper decile."""


class AutocorrelationRow(TypedDict):
    """Autocorrelation of the position errors in the long test rollouts: structure that no law has explained."""

    lag: Numbers
    """Lags [s]."""
    band: NotNegative
    """Errors without structure lie within +- this, 95 % of the time."""
    coefficient: Curves
    """Mean over rollouts, by label."""


class Comparison(TypedDict):
    """Runs on the same data and the same rollouts side by side, best first.

    Numbers are SI, angles radians; null stands for a number that does not exist (all rollouts diverged). Errors are
    position MAE in `unit`.
    """

    schema_version: Literal[6]
    """Raised by every change that a reader of this file could notice."""
    data: DataRow
    joints: Joints
    """Names of the identified joints, in the order of lists."""
    unit: Literal["rad", "m"]
    """Unit of position errors."""
    velocity_unit: Literal["rad/s", "m/s"]
    """Unit of velocities."""
    torque_unit: Literal["N m", "N"]
    """Unit of friction and load."""
    evaluation: RolloutsRow
    recommendation: RecommendationRow | None
    """The simplest run within noise of the best; null where every run lost all its test rollouts."""
    reference: str | None
    """Label of the run without friction against which `change` is; null: each run against the drive without friction
    that it identified itself, on test data only."""
    reference_doubt: str | None
    """Why a change against it says little: it ended at a bound; null where it did not."""
    runs: Annotated[list[RunRow], ("minItems", 1)]
    """One entry a run: fewest diverged test rollouts first, then lowest test error."""
    failures: list[FailureRow]
    """Jobs without a result."""
    differences: list[DifferenceRow]
    """Options besides data, evaluation and the law's own in which the runs differ."""
    pairs: list[PairRow]
    """Every pair of runs: paired bootstrap over the main test rollouts."""
    by_horizon: GrowthRow
    by_speed: BinnedRow
    """Error of short test rollouts in bins of the mean absolute measured velocity, in `velocity_unit`."""
    by_load: BinnedRow
    """Error of short test rollouts in bins of the mean absolute torque of the motor, in `torque_unit`."""
    friction: dict[str, FrictionRow]
    """Friction torque over velocity, by label."""
    autocorrelation: AutocorrelationRow
