"""Types of `result.json`, from which `make docs` generates `result.schema.json`.

The text below a field becomes its description.
"""

from typing import Annotated, Any, Literal

from msgspec import Meta

from frictionzoo.core.log import Origin
from frictionzoo.core.records import (
    Carried,
    Count,
    Interval,
    Intervals,
    Joints,
    Natural,
    NotNegative,
    Number,
    Positive,
    Proof,
    Record,
    Samples,
    Sha256,
    Simulator,
    Text,
    WhereThere,
)
from frictionzoo.result.card import Card
from frictionzoo.result.section_types import (
    AutomaticSetting,
    FitRecord,
    Links,
    PairedColumns,
    Residual,
    Timing,
    Torque,
    Verdict,
    Versions,
    WrittenModel,
)


class UsedLog(Record):
    """One recording or one block of a recording."""

    name: str
    """Source of the log; `NAME[part]` for a block of time of a recording."""
    part: Literal["train", "test"]
    """Use of the log: `train` in the fit, `test` held out."""
    samples: Samples
    """Number of samples."""
    sha256: Sha256
    """SHA-256 of the log's whole source."""
    payload: Carried | None
    """Payload of the drive: mass [kg], centre of mass x, y, z [m], inertia ixx, iyy, izz [kg m^2]."""


class Data(Record):
    """The data set, recorded or simulated."""

    name: str
    """Name of the data set."""
    sha256: Sha256
    """SHA-256 of the source; for several sources, SHA-256 of their distinct hashes in the order of `logs`, joined by
    line feeds."""
    origin: Origin | None
    """Origin stated by `data.origin`: hardware recordings, or data that are simulated at least in part; null: not
    stated."""
    timestep: Positive
    """Sample interval [s]."""
    samples: Samples
    """Number of samples in all logs, training and test."""
    logs: Annotated[list[UsedLog], Meta(min_length=2)]
    """All recordings or blocks of recordings."""


class Value(Record):
    """Value of a parameter for one joint, or for joints that share a value."""

    name: Text
    """Joint or group of joints: the group's name in `tie`, or `all joints`. Joints of a group with different known
    values have separate entries."""
    joints: Joints
    """Names of the joints with this value."""
    value: float
    """Value in the parameter's unit."""
    low: float
    """Lower bound of the fit."""
    high: float
    """Upper bound of the fit."""
    identified: bool
    """Whether the fit chose the value; false: known value."""
    at_bound: bool
    """Whether the fit ended at a bound; false for a known value."""
    interval: Interval | None
    """95 % confidence interval [lower end, upper end]; null: none."""
    identifiable: bool | None
    """Whether the data determine the value; null: known value, or no intervals estimated."""


class ReferenceParameter(Record):
    """One physical parameter of a fitted drive, without its uncertainty."""

    name: str
    """Name of the parameter in MuJoCo or the literature."""
    owner: Literal["bench", "friction"]
    """Owner of the parameter: bench or friction model."""
    value: float | WhereThere
    """Value; with several joints, a list in their order, with null for joints whose friction model lacks the
    parameter."""
    unit: str
    """SI unit; 1 for a dimensionless number."""
    low: float | WhereThere
    """Lower bound of the fit; a list in the order of the joints if it differs between them."""
    high: float | WhereThere
    """Upper bound of the fit; a list in the order of the joints if it differs between them."""
    identified: bool
    """Whether the fit chose the value, in at least one joint; false: known value."""
    at_bound: bool
    """Whether the fit ended at a bound, in at least one joint; false for a known value. At a bound, the best value may
    lie outside the bounds. If true for the frictionless reference, it is not a realistic drive, and changes relative to
    its errors mean little."""
    by_joint: Annotated[list[Value], Meta(min_length=1)]
    """The same for each joint, in their order; joints that share a value have one entry."""


class ParameterRecord(ReferenceParameter):
    """One physical parameter of the bench or the friction model."""

    interval: Intervals | None
    """95 % confidence interval [lower end, upper end], limited to the bounds; with several joints, a list in their
    order. It follows from the curvature of the loss and the variation of its gradient between stretches of the training
    data, or between recordings. With `discretisation`, it extends to the value extrapolated to a timestep of 0. null:
    known value, value at a bound, no effect on the data, or an effect only in combination with other parameters; see
    also `no_intervals`."""
    identifiable: bool | None
    """Whether the data determine the value. false: in at least one joint, the interval is missing, reaches a bound or
    is too wide. null: known value, or no intervals estimated."""

    def __post_init__(self) -> None:
        """Refuse a list of numbers that is not an interval."""
        ends = [isinstance(end, float) for end in self.interval or ()]
        if any(ends) and not (all(ends) and len(ends) == 2):
            raise ValueError(f"interval {self.interval}, expected two numbers, or two or null for each joint")


class Network(Record):
    """Trained network of a friction model."""

    weights: Count
    """Number of weights and biases."""


class Metrics(Record):
    """Errors of open-loop rollouts from measured states under recorded commands.

    The errors exclude diverged rollouts.
    """

    position_mae: NotNegative | None
    """Mean absolute position error: average over time and joints in each rollout, then mean over the rollouts
    [unit]."""
    position_mae_std: NotNegative | None
    """Population standard deviation of the rollouts' mean absolute position errors [unit]; 0 for one rollout."""
    position_rmse: NotNegative | None
    """Root mean square position error over all samples [unit]."""
    velocity_rmse: NotNegative | None
    """Root mean square velocity error over all samples [velocity_unit]."""
    unit: Literal["rad", "m"]
    """Unit of the position errors."""
    velocity_unit: Literal["rad/s", "m/s"]
    """Unit of the velocity error."""
    horizon: Positive
    """Length of each rollout [s]."""
    rollouts: Count
    """Number of simulated rollouts."""
    diverged: Natural
    """Number of diverged rollouts, with a value that is not finite."""


class PartMetrics(Record):
    """Errors on each part of the data."""

    train: Metrics
    """Errors on the training logs."""
    test: Metrics
    """Errors on the test logs."""
    baseline: Metrics
    """Errors of the frictionless reference on the rollouts of `test`."""


class JointErrors(Record):
    """Errors of one joint in the rollouts of one part, without diverged rollouts."""

    position_mae: NotNegative | None
    """Mean absolute position error [unit]; its mean over the joints is `metrics.PART.position_mae`."""
    position_rmse: NotNegative | None
    """Root mean square position error [unit]."""
    velocity_rmse: NotNegative | None
    """Root mean square velocity error [velocity_unit]."""


class JointMetrics(Record):
    """Errors of one joint on each part of the data, in the rollouts and units of `metrics`."""

    joint: Text
    """Name of the joint."""
    train: JointErrors
    """Errors on the training logs."""
    test: JointErrors
    """Errors on the test logs."""
    baseline: JointErrors
    """Errors of the frictionless reference on the rollouts of `test`."""


class HorizonMetrics(Record):
    """Errors of rollouts of one length on each part of the data."""

    horizon: Positive
    """Length of each rollout [s]."""
    train: Metrics
    """Errors on the training logs."""
    test: Metrics
    """Errors on the test logs."""
    baseline: Metrics
    """Errors of the frictionless reference on the rollouts of `test`."""


class Contrast(Record):
    """Errors with and without friction."""

    model: Metrics
    """Errors of the identified drive."""
    baseline: Metrics
    """Errors of the frictionless reference on the same rollouts."""


class Paper(Record):
    """The two evaluations of Kovalev et al. (2026), on test data."""

    a: Contrast
    """One long rollout, as in figures 4 and 5."""
    b: Contrast
    """Rollouts of the main horizon at random places."""


class EvaluationRollouts(Record):
    """The evaluation rollouts."""

    sha256: Sha256
    """SHA-256 of all measured windows and payloads. Runs with the same hash have the same evaluation rollouts and can
    be compared."""
    window: Positive
    """Width of the moving mean of the long rollout's error in figures [s]."""


class JointUncertainty(Record):
    """Joint uncertainty of all parameters with an interval: a multivariate Student's t distribution.

    It describes the optimiser's coordinates: logarithms, or values divided by a scale. Its marginals are the intervals.
    """

    labels: Annotated[list[Text], Meta(min_length=1)]
    """Full names of the parameters: OWNER.NAME; with several joints OWNER.NAME/JOINT, where JOINT is the joint or the
    group that shares the value."""
    scale: list[Literal["log"] | float]
    """Conversion from value to coordinate: `log`, or the divisor."""
    centre: list[float]
    """Middle of each interval, as coordinates; the identified value, unless the fit ended away from its minimum."""
    matrix: list[list[float]]
    """Shape matrix: half an interval is the 97.5 % quantile of Student's t times the square root of the diagonal
    entry."""
    freedom: Positive
    """Degrees of freedom of the t distribution."""


class Result(Record):
    """The record of one identification run.

    Numbers are in SI units, angles in radians. null stands for a number that does not exist, for example if all
    rollouts diverged or nothing was fitted. A run writes this file last: if it exists, so do the run's other files.
    """

    schema_version: Literal[10]
    """Schema version, increased by every change that affects readers of the file."""
    model: Text
    """Name of the friction model."""
    joints: Joints
    """Names of the identified joints; lists with one entry for each joint have this order."""
    data: Data
    columns: list[PairedColumns]
    """Columns of each joint in the recordings; empty if the recordings are not tables."""
    parameters: list[ParameterRecord]
    """Physical parameters of bench and friction model. Network weights are in friction.safetensors."""
    indistinct: list[Annotated[list[str], Meta(min_length=2)]]
    """Groups of parameters that the data cannot tell apart, by full name: OWNER.NAME; with several joints
    OWNER.NAME/JOINT, where JOINT is the joint or the group that shares the value. The data determine only a combination
    of each group: set all but one of its parameters to known values."""
    no_intervals: str | None
    """Reason why no parameter has an interval; null: intervals estimated."""
    covariance: JointUncertainty | None
    """Joint uncertainty of the parameters; null: no parameter has an interval."""
    network: Network | None
    """Trained network of the friction model; null: the model has none."""
    metrics: PartMetrics
    """Errors of open-loop rollouts at the main horizon, the first of `by_horizon`."""
    by_horizon: Annotated[list[HorizonMetrics], Meta(min_length=1)]
    """The errors of `metrics` at every horizon of the evaluation."""
    paper: Paper
    by_joint: Annotated[list[JointMetrics], Meta(min_length=1)]
    """Errors of each joint in the rollouts of `metrics`, in the order of `joints`."""
    torque: Torque | None
    """Residual torque against recorded torque, with the final values and without a simulation: the drive's torque minus
    armature times acceleration, sliding friction, and the links' torque from MuJoCo's inverse dynamics. Positions are
    the recorded ones after a zero-phase low-pass; velocities and accelerations are their derivatives. All torques pass
    the zero-phase low-pass of inverse_dynamics and are decimated to 2.5 samples per period of the bandwidth. One such
    period at each end of each log is excluded; all other samples count, slow ones too. A model with memory contributes
    its steady torque at constant velocity. null: no recorded torque, a model that exists only in torch, or logs that
    are too short."""
    residual: Residual | None
    """Residual analysis of the training recordings, without a simulation: whether the residual torque is noise, and
    otherwise which factors explain it. The residual torque is the actuator model's torque minus armature times
    acceleration, friction, and the links' torque from MuJoCo's inverse dynamics, filtered as in `torque`. Samples near
    rest are excluded. The memory of a friction model follows the recorded motion. null: the training recordings are too
    short, or the residual torque or its derivative is not finite."""
    links: Links | None
    """Link inertias (`fit.links`) and gravity (`fit.tilt`) estimated before the fit, with their uncertainty; null:
    neither was estimated."""
    reference: list[ReferenceParameter]
    """Parameters of the frictionless reference: the same bench, fitted without friction to the same segments. Its
    errors are in `metrics.baseline`."""
    evaluation: EvaluationRollouts
    fit: FitRecord
    timing: Timing
    recipe: list[AutomaticSetting]
    """Automatic settings (`recipe=auto`): the options chosen on the training recordings, in the order of choice; empty:
    no option was chosen."""
    seed: int
    """Seed of all random numbers in the run."""
    dtype: Number
    """Floating-point type of the simulation."""
    engine: Simulator
    """Simulation engine."""
    proof: Proof
    """Verification: largest difference between the engine and MuJoCo C with the MJCF that would be exported, in
    float64, on short rollouts from states within and beyond the recorded range. A run with a difference above 1e-9
    stops before the fit."""
    warnings: list[Text]
    """Reasons to doubt the result, one sentence each with the remedy, from the diagnostics of recordings and bench and
    from the automatic settings."""
    notes: list[Text]
    """Parts of a robot's model file that were left out or changed, one sentence each."""
    device: Text
    """Device of the computation, for example cpu."""
    versions: Versions
    """Versions of the packages that affect the numbers."""
    card: Card | None
    """Drive published without recordings and machine paths: with file names instead of paths, no commands in
    `verdict`, and the bench of template.xml in `settings`; null: an ordinary run."""
    settings: dict[str, Any]
    """All options of the run, as in `.hydra/config.yaml`, with computed values. For a distilled drive also `teacher`,
    the folder of the teacher's run."""
    written: list[WrittenModel]
    """Model files written by the run; empty for a drive that was not saved."""
    not_identified: list[Text] | None
    """Reason why the fit did not identify the drive, followed by the likely causes, likeliest first; null: no sign of
    failure."""
    verdict: Verdict
    """Overall assessment of the result, with next steps."""
