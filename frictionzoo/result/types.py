"""What `result.json` holds, as types.

`make docs` makes `result.schema.json` from them: the text below a key describes it, and what stands beside a type in
`Annotated` are keywords of JSON schema.
"""

from typing import Annotated, Any, Literal, TypedDict

from frictionzoo.core.log import Origin
from frictionzoo.result.kinds import (
    Carried,
    Count,
    Interval,
    Intervals,
    Joints,
    Natural,
    NotNegative,
    Number,
    PerJoint,
    Positive,
    Samples,
    Sha256,
    Simulator,
    Text,
    WhereThere,
)
from frictionzoo.result.residual_types import ResidualRow
from frictionzoo.result.run_types import ChoiceRow, ColumnsRow, FitRow, ProofRow, TimingRow, Versions, WrittenRow
from frictionzoo.result.torque_types import LinksRow, TorqueRow
from frictionzoo.result.verdict_types import VerdictRow


class LogRow(TypedDict):
    """One recording, or a block of one."""

    name: str
    """Its source; `NAME[part]` for a block of time of a recording."""
    part: Literal["train", "test"]
    """Whether the fit saw it."""
    samples: Samples
    """Its samples."""
    sha256: Sha256
    """Hash of the whole source that it came from."""
    payload: Carried | None
    """What the drive carried: mass [kg], centre x, y, z [m], inertia ixx, iyy, izz [kg m^2]."""


class DataRow(TypedDict):
    """What was read, or made by a simulator."""

    name: str
    """The data set."""
    sha256: Sha256
    """Hash of what was read: the source's where there is one; for several sources, the hash of their distinct hashes
    in the order of `logs`, joined by line feeds."""
    origin: Origin | None
    """What `data.origin` states: recorded on hardware, or made by a simulator, if only in part; null: not stated."""
    timestep: Positive
    """Sample interval [s]."""
    samples: Samples
    """Samples in all logs, train and test."""
    logs: Annotated[list[LogRow], ("minItems", 2)]
    """Every recording or block of one."""


class ValueRow(TypedDict):
    """A parameter's value of one joint, or of joints that share it."""

    name: Text
    """The joint, or the group of joints: its name in `tie`, or `all joints`. Of known values, joints of a group that do
    not have the same one are told apart."""
    joints: Joints
    """Names of the joints that have the value."""
    value: float
    """In the parameter's unit."""
    low: float
    """Lower bound of the fit."""
    high: float
    """Upper bound of the fit."""
    identified: bool
    """True: the fit chose the value. False: it was given."""
    at_bound: bool
    """The fit ended at a bound; false for a known value."""
    interval: Interval | None
    """Lower and upper end of the 95 % interval; null: none."""
    identifiable: bool | None
    """Whether the data determine it; null: known, or nobody asked."""


class ReferenceRow(TypedDict):
    """One parameter of the bench without friction."""

    name: str
    """As in `parameters`."""
    owner: Literal["bench"]
    """It has no friction law."""
    value: float | PerJoint
    """A number for one joint, a list in the order of the joints for several."""
    unit: str
    """SI unit; 1 for a pure number."""
    low: float | PerJoint
    """Lower bound of the fit; a list in the order of the joints where they differ."""
    high: float | PerJoint
    """Upper bound of the fit, likewise."""
    identified: bool
    """True: the fit chose the value, of several joints that of one at least. False: it was given."""
    at_bound: bool
    """It ended at a bound, in one joint at least: then errors without friction are those of no drive, and a change
    against them says little."""
    by_joint: Annotated[list[ValueRow], ("minItems", 1)]
    """The same joint by joint, in their order; joints that share a value are one entry."""


class ParameterRow(TypedDict):
    """One physical parameter of bench or friction law."""

    name: str
    """MuJoCo's or the literature's word."""
    owner: Literal["bench", "friction"]
    """What it belongs to."""
    value: float | WhereThere
    """A number for one joint, a list in the order of the joints for several; null where a joint's law has no such
    parameter."""
    unit: str
    """SI unit; 1 for a pure number."""
    low: float | WhereThere
    """Lower bound of the fit; a list in the order of the joints where they differ."""
    high: float | WhereThere
    """Upper bound of the fit, likewise."""
    identified: bool
    """True: the fit chose the value, of several joints that of one at least. False: it was given."""
    at_bound: bool
    """The fit ended at a bound, in one joint at least, so that the data may ask for more than the bounds allow; false
    for known parameters."""
    interval: Interval | Intervals | None
    """Lower and upper end of the 95 % interval, by the spread between stretches of the training data, or between
    recordings, and with `discretisation` from the value to where shorter steps would have it, within the bounds; for
    several joints a list of them in their order. null: none, for a known parameter, at a bound, and where
    the data show no effect of it, or one in combination with others only; see also `no_intervals`."""
    identifiable: bool | None
    """Whether the data determine it. False: it has no interval, or one that reaches a bound or is too wide, in any
    joint. null: known, or there are no intervals."""
    by_joint: Annotated[list[ValueRow], ("minItems", 1)]
    """The same joint by joint, in their order; joints that share a value are one entry."""


class NetworkRow(TypedDict):
    """A law's trained network."""

    weights: Count
    """Number of its weights and biases."""


class MetricsRow(TypedDict):
    """Errors of open-loop rollouts from measured states under recorded commands.

    Diverged rollouts are left out of the errors.
    """

    position_mae: NotNegative | None
    """Mean over rollouts of each one's absolute position error, averaged over time and joints [unit]."""
    position_mae_std: NotNegative | None
    """Population standard deviation of that error over the rollouts [unit]; 0 for one rollout."""
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
    """How many were simulated."""
    diverged: Natural
    """How many of them left the finite numbers."""


class PartsRow(TypedDict):
    """Errors on each part of the data."""

    train: MetricsRow
    """On the logs that the fit saw."""
    test: MetricsRow
    """On the logs that it did not see."""
    baseline: MetricsRow
    """The same bench identified without friction on the same segments, judged on the rollouts of `test`."""


class JointErrorsRow(TypedDict):
    """Errors of one joint in the rollouts of one part, those that diverged left out."""

    position_mae: NotNegative | None
    """Mean absolute position error [unit]; its mean over the joints is `metrics.PART.position_mae`."""
    position_rmse: NotNegative | None
    """Root mean square position error [unit]."""
    velocity_rmse: NotNegative | None
    """Root mean square velocity error [velocity_unit]."""


class JointRow(TypedDict):
    """Errors of one joint on each part of the data, in the rollouts and units of `metrics`."""

    joint: Text
    """Its name."""
    train: JointErrorsRow
    """On the logs that the fit saw."""
    test: JointErrorsRow
    """On the logs that it did not see."""
    baseline: JointErrorsRow
    """The same bench identified without friction on the same segments, judged on the rollouts of `test`."""


class HorizonRow(TypedDict):
    """Errors of rollouts of one length on each part of the data."""

    horizon: Positive
    """Length of each rollout [s]."""
    train: MetricsRow
    """On the logs that the fit saw."""
    test: MetricsRow
    """On the logs that it did not see."""
    baseline: MetricsRow
    """The same bench identified without friction on the same segments, judged on the rollouts of `test`."""


class ContrastRow(TypedDict):
    """One simulated drive beside another."""

    model: MetricsRow
    """The identified drive."""
    baseline: MetricsRow
    """The same bench identified without friction on the same segments, judged on the same rollouts."""


class PaperRow(TypedDict):
    """The two evaluations of Kovalev et al. (2026), on test data."""

    a: ContrastRow
    """One long rollout, which figures 4 and 5 show."""
    b: ContrastRow
    """Rollouts of the main horizon at random places."""


class EvaluationRow(TypedDict):
    """The rollouts on which the drive was judged."""

    sha256: Sha256
    """Hash of all measured windows; runs with the same one were judged on the same rollouts and can be compared."""
    window: Positive
    """Length of the moving mean over the error of the long rollout, in figures [s]."""


class CovarianceRow(TypedDict):
    """How sure parameters are together: a multivariate Student's t distribution of all that have an interval.

    It is one of the optimiser's coordinates, logarithms or values over a scale; its marginals are the intervals.
    """

    labels: Annotated[list[Text], ("minItems", 1)]
    """Their full names OWNER.NAME, of several joints OWNER.NAME/JOINT with the name of the joint, or of the joints that
    share the value."""
    scale: list[Literal["log"] | float]
    """What makes a coordinate of a value: `log`, or the number that it is divided by."""
    centre: list[float]
    """Middle of each interval; the identified value, unless the fit ended away from its minimum."""
    matrix: list[list[float]]
    """Its shape: half an interval is the 97.5 % quantile of Student's t times the root of the diagonal."""
    freedom: Positive
    """Degrees of freedom of the t distribution."""


class Result(TypedDict):
    """The record of one identification run.

    Numbers are SI, angles radians; null stands for a number that does not exist (all rollouts diverged, or nothing was
    fitted). A run writes this file last: where it exists, the run's other files do too.
    """

    schema_version: Literal[8]
    """Raised by every change that a reader of this file could notice."""
    model: Text
    """The chosen model, a file of conf/model."""
    joints: Joints
    """Names of the identified joints, in the order of lists."""
    data: DataRow
    columns: list[ColumnsRow]
    """Which columns of the recordings belong to which joint; empty for recordings that came from no table."""
    parameters: list[ParameterRow]
    """Physical parameters of bench and friction law. A network's weights are in friction.safetensors."""
    indistinct: list[Annotated[list[str], ("minItems", 2)]]
    """Groups of parameters that the data cannot tell apart, by their full names OWNER.NAME, of several joints
    OWNER.NAME/JOINT with the name of the joint, or of the joints that share the value. Only a combination of a group is
    determined, so make all but one of it known."""
    no_intervals: str | None
    """Why no parameter has an interval; null where the data were asked for them."""
    covariance: CovarianceRow | None
    """How sure parameters are together; null where none has an interval."""
    network: NetworkRow | None
    """The law's trained network; null for a law without one."""
    metrics: PartsRow
    """Open-loop rollouts at the main horizon, the first of `by_horizon`."""
    by_joint: Annotated[list[JointRow], ("minItems", 1)]
    """Errors of each joint in the rollouts of `metrics`, in the order of `joints`."""
    torque: TorqueRow | None
    """What is left of recorded torque with the final values, without a simulation: the drive's torque less armature
    times acceleration, friction while sliding, and MuJoCo's inverse dynamics of the links, at the recorded positions,
    low-passed forwards and backwards, with velocities and accelerations from these alone. All of it passes the low-pass
    of inverse_dynamics, forwards and backwards, and is decimated to two and a half samples a period of the bandwidth.
    The ends of each log, one such period, are left out; all other samples count, slow ones too. A law with a memory
    counts by what it comes down to at constant velocity. null where the recordings have no torque, for a law that
    exists only in torch, and where the logs are too short."""
    residual: ResidualRow | None
    """Whether the drive leaves only noise of the training recordings' torque, without a simulation: the torque of the
    actuators by their law, less armature times acceleration, friction, and MuJoCo's inverse dynamics of the links, at
    the recorded positions, filtered as in `torque`. Samples near a joint's rest are left out; a law with a memory
    carries it along. null where the training recordings are too short."""
    links: LinksRow | None
    """Inertias of links that `fit.links` names, and gravity with `fit.tilt`, and how far the data determine them; null
    where there are none."""
    reference: list[ReferenceRow]
    """Parameters of the bench without friction, whose errors `metrics.baseline` holds."""
    by_horizon: Annotated[list[HorizonRow], ("minItems", 1)]
    """The same metrics at every horizon of the evaluation."""
    paper: PaperRow
    evaluation: EvaluationRow
    fit: FitRow
    timing: TimingRow
    recipe: list[ChoiceRow]
    """With `recipe=auto`, what was left open and found on the training recordings, in the order in which it was found;
    empty where all options were given."""
    seed: int
    """Seed of everything random in the run."""
    dtype: Number
    """Number type of the simulation."""
    engine: Simulator
    """What simulated."""
    proof: ProofRow
    """How far the engine is from MuJoCo C with the MJCF that would be exported, in float64, on short rollouts from
    states within the recorded range and beyond, before the fit. A run in which they differ by more than 1e-9 does not
    begin."""
    warnings: list[Text]
    """What in the recordings, in the recorded motion of the model, or in the size of what was identified makes the
    result doubtful, a sentence each with what mends it."""
    notes: list[Text]
    """What a robot's file has that was left out or changed, a sentence each."""
    written: list[WrittenRow]
    """The model files that the run left behind; empty for a drive that was not saved."""
    not_identified: list[Text] | None
    """Null, or that the fit did not identify the drive: why that is said, and the likely reasons, the likeliest
    first."""
    verdict: VerdictRow
    """What a good reviewer would say of it, and what to do next."""
    device: Text
    """Where it ran, for example cpu."""
    versions: Versions
    """Versions of what the numbers depend on."""
    settings: dict[str, Any]
    """Every option of the run, as `.hydra/config.yaml` has them, with all values computed; of a distilled drive also
    `teacher`, the folder of the run that it follows."""
