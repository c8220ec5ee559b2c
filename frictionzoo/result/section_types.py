"""Types of the sections of `result.json`: the run, its torque, residual analysis and verdict."""

from typing import Annotated, Literal

from msgspec import Meta, field

from frictionzoo.core.records import Count, Moments, Natural, NotNegative, Positive, Record, Text, Vector


class FitRecord(Record):
    """The fit."""

    method: str
    """Fit method: adam, grid, inverse_dynamics, known, lm, several, or a registered one."""
    iterations: Natural
    """Number of iterations; for a grid, of its points."""
    best_iteration: Natural
    """Iteration with the lowest loss on the whole training set, counted from 0; the reported values are from this
    iteration."""
    loss: float | None
    """Loss of the best iteration, weighted as configured."""
    stopped: Text
    """Reason why the fit ended: converged, finished (all iterations made), patience, or diverged."""
    falling: NotNegative
    """Relative decrease of the lowest loss in the last tenth of the iterations; 0 for a grid, and for a fit that
    stopped early."""
    moving: list[str]
    """Parameters that still moved in the last tenth of the iterations: by more than a third of half their interval, or
    by 1 % of their value if they have none. Names are `owner.name`, with several joints `owner.name/JOINT`."""


class AutomaticSetting(Record):
    """An option set automatically."""

    option: Text
    """Dotted name of the option."""
    value: int | float | bool | str | list[float] | None
    """Chosen value."""
    reason: Text
    """Reason for the choice."""

    def __str__(self) -> str:
        value = "null" if self.value is None else self.value
        return f"{self.option}={str(value).lower() if isinstance(value, bool) else value}: {self.reason}"


class JointColumns(Record):
    """Columns of one joint."""

    joint: Text
    """Name of the joint."""
    columns: dict[str, str]
    """Column header for each signal: `qpos`, `ctrl` and other recorded signals. A column that serves all joints is
    listed for each of them."""


class PairedColumns(Record):
    """Logs with the same headers, and the columns of each joint."""

    logs: Annotated[list[str], Meta(min_length=1)]
    """Names of the logs, as in `data.logs`."""
    by: dict[str, Literal["name", "listed", "place"]]
    """Matching of the columns of each signal. `name`: the headers name the joints. `listed`: the order of
    `data.columns` counts. `place`: the headers do not name the joints, and the order of the columns counts."""
    joints: Annotated[list[JointColumns], Meta(min_length=1)]
    """Columns of each joint, in the order of `joints`."""


class Timing(Record):
    """Wall-clock times [s]."""

    setup: NotNegative
    """Time to read or simulate the data, build bench and model, run the diagnostics, choose automatic settings and
    verify the engine [s]."""
    compile: NotNegative
    """Compilation time of the fit's rollouts [s]."""
    fit: NotNegative
    """Time of the fit without compilation [s]."""
    uncertainty: NotNegative
    """Time to estimate the intervals, with compilation [s]."""
    evaluate: NotNegative
    """Time of the evaluation rollouts, the fit without friction and the residual analysis [s]."""
    total: NotNegative
    """Time from the start of the run to this file [s]."""


class WrittenModel(Record):
    """A model file written by the run, and its difference from the identified drive in MuJoCo C.

    The file is loaded unchanged: with its timestep, integrator, actuators and actuator delay, and with the recorded
    command as `ctrl`. A robot's own file is simulated under the conditions of the bench: base and other joints are
    fixed, and it has the contacts and limits of the bench.
    """

    file: Text
    """File name in the run's folder."""
    timestep: Positive
    """Timestep of the file [s]."""
    mean: NotNegative | None
    """Mean absolute position difference from the identified drive in the long test rollouts [unit]; null: not compared,
    for the reason in `limits`."""
    largest: NotNegative | None
    """Largest absolute position difference [unit]."""
    unit: Literal["rad", "m"]
    """Unit of the differences."""
    share: NotNegative | None
    """`mean` relative to the identified drive's test error, `metrics.test.position_mae`."""
    exact: bool
    """Whether the largest difference is rounding error, at most 1e-9."""
    over: str
    """Description of the compared rollouts; empty: none."""
    reason: str
    """Short reason for the difference; empty: no difference is expected."""
    limits: list[Text]
    """Limits of the file and instructions for its user, one sentence each."""


class Versions(Record):
    """Versions of the packages that affect the numbers."""

    python: str
    frictionzoo: str
    mujoco: str
    mujoco_mjx: str = field(name="mujoco-mjx")
    jax: str
    torch: str
    optax: str
    lightning: str
    numpy: str


class TorqueErrors(Record):
    """Root mean squares over all compared samples of one part, for one joint or as the mean over the joints [unit].

    null: not finite.
    """

    residual: NotNegative | None
    """Residual torque: the drive's torque minus the torque that armature, friction and links need for the motion."""
    torque: NotNegative | None
    """The drive's torque."""


class TorqueParts(Record):
    """Mean over the joints on each part of the data."""

    train: TorqueErrors
    """Torques on the training logs."""
    test: TorqueErrors
    """Torques on the test logs."""


class JointTorque(Record):
    """Torques of one joint on each part of the data."""

    joint: Text
    """Name of the joint."""
    train: TorqueErrors
    """Torques on the training logs."""
    test: TorqueErrors
    """Torques on the test logs."""


class Torque(Record):
    """Residual torque of each joint."""

    compared: Literal["torque", "ctrl"]
    """Source of the drive's torque. torque: the recorded torque at its instant, unchanged by actuator model and
    offsets. ctrl: the command of a torque drive through its actuator model, with the final gain, offset, limits and
    delay."""
    unit: Literal["N m", "N"]
    """Unit of the torques."""
    bandwidth: Positive
    """Bandwidth of the comparison [Hz]; see `evaluation.torque`."""
    held: bool
    """Whether the command is held until the next sample; false: it acts at its instant only, like measured torque."""
    mean: TorqueParts
    """Mean over the joints."""
    by_joint: Annotated[list[JointTorque], Meta(min_length=1)]
    """The same for each joint, in the order of `joints`."""


class Inertia(Record):
    """Inertia of a body."""

    mass: Positive
    """Mass [kg]."""
    centre: Vector
    """Centre of mass x, y, z in the body's frame [m]."""
    inertia: Moments
    """Inertia about the centre of mass, along the axes of the body's frame: ixx, iyy, izz, ixy, ixz, iyz [kg m^2]."""


class Link(Record):
    """A link with estimated inertia."""

    body: Text
    """Name of the body."""
    found: Inertia
    """Estimated inertia; physically consistent, with the model file's inertia as the prior."""
    maker: Inertia
    """Inertia in the model file."""
    prior_only: list[str]
    """Parameters of the link that the data do not determine, alone or in combination; their values come from the prior.
    Symbols: m [kg], mx, my, mz [kg m], Ixx, Iyy, Izz, Ixy, Ixz, Iyz [kg m^2, about the frame's origin]."""


class BaseParameter(Record):
    """A base parameter: a combination of parameters of links, armatures and other torque terms."""

    combination: Text
    """The combination in words, named after its first parameter."""
    value: float
    """Value in SI units."""
    error: NotNegative | None
    """Standard error from the data alone, without the prior; null: infinite."""
    determined: bool
    """Whether the data, not the prior, determine the value: the standard error is below a third of the prior's standard
    deviation, or of the value if it has no prior."""


class Gravity(Record):
    """Gravity in the frame of the base, with the magnitude of the model file."""

    found: Vector
    """Estimated gravity [m/s^2]."""
    maker: Vector
    """Gravity in the model file [m/s^2]."""
    angle: NotNegative
    """Angle between the two, the tilt of the base [rad]."""
    error: NotNegative | None
    """Standard error of the angle, with the prior of the links: the larger value of two directions [rad]; null:
    infinite."""


class Links(Record):
    """Link inertias and gravity, estimated before the fit."""

    links: list[Link]
    """Estimated inertia of each link; the rest of the run treats it as known."""
    gravity: Gravity | None
    """Estimated gravity (`fit.tilt`); the rest of the run treats it as known. null: gravity of the model file."""
    determined: Natural
    """Number of base parameters determined by the data."""
    base: list[BaseParameter]
    """All base parameters that torque can determine, of the links and of the parameters estimated with them; parameters
    in none of them have no effect."""


class ResidualFactor(Record):
    """A residual factor: a quantity that explains part of the residual torque."""

    place: Literal[
        "constant",
        "scale",
        "limit",
        "late",
        "speed",
        "slow",
        "fast",
        "direction",
        "load",
        "position",
        "pull",
        "temperature",
        "reversal",
        "gap",
    ]
    """Name of the factor. `constant`: a constant torque; `scale`: the torque needed for the motion; `limit`: commanded
    torque beyond a limit; `late`: rate of the actuator torque, as from a delay; `speed`: speed; `slow`: low speed;
    `fast`: high speed; `direction`: direction of motion; `load`: load on the gear; `position`: position, against the
    motion; `pull`: position, equal in both directions, which is not friction; `temperature`: temperature; `reversal`:
    time since the last reversal of the motion; `gap`: time around sign changes of the motor torque, as from
    backlash."""
    periods: Positive | None
    """Periods of a ripple over the position, as in the model `ripple`: per turn on a hinge, 2 pi / period [1/m] on a
    slide; null: no ripple."""
    value: float | None
    """Estimated value: the constant torque or the limit [unit], the factor of the actuator torque, or the delay [s];
    null: no single value."""
    share: float
    """Share of the residual torque's variance explained in held-out stretches of time, beyond the factors found before
    it and beyond its effect in the reference (`noise`). For `gap`, the share concentrated around the sign changes."""
    torque: NotNegative
    """Root mean square of the explained part [unit]."""
    chance: float
    """Upper bound of the probability that noise alone gives such a result for any factor in any joint."""
    known: bool
    """Whether the model already has a term for this factor, in another form or with a parameter at a bound."""
    law: Text | None
    """Friction model of the package with such a term; null: none."""
    whole: bool
    """Whether that model also has all terms of the present model."""


class JointResidual(Record):
    """Residual torque of a joint in motion."""

    joint: Text
    """Name of the joint."""
    rows: Count
    """Number of compared torques."""
    residual: NotNegative
    """Root mean square residual torque [unit]."""
    noise: NotNegative
    """Root mean square residual torque of a reference without model error [unit]: the identified drive, simulated under
    the same commands and measured with the same encoder step and noise. If its motion differs too much from the
    recording, the effect of encoder noise on the recording."""
    friction: NotNegative
    """Root mean square friction: the model's friction plus the residual torque [unit]."""
    correlation: float
    """Correlation of the residual torque between consecutive samples."""
    noise_correlation: float
    """The same for the reference (`noise`)."""
    kurtosis: float
    """Excess kurtosis of the residual torque; 0 for normal noise."""
    places: Annotated[list[ResidualFactor], Meta(max_length=3)]
    """Significant residual factors, largest share first; empty: no tested factor explains the residual torque."""


class Residual(Record):
    """Residual torque under the training commands."""

    unit: Literal["N m", "N"]
    """Unit of all torques or forces in this section."""
    bandwidth: Positive
    """Bandwidth of the analysis [Hz]: as in `torque`, or lower if encoder noise dominates."""
    by_joint: list[JointResidual]
    """Residual analysis of each joint that moves enough."""


Grade = Literal["no problems found", "use it with care", "do not use it"]


class ResultFinding(Record):
    """A problem of the result."""

    kind: Literal[
        "identification",
        "recordings",
        "torque",
        "gain",
        "joints",
        "reference",
        "train",
        "fit",
        "bounds",
        "identifiability",
        "stability",
        "residual",
    ]
    """Subject of the check."""
    severe: bool
    """Whether the problem makes the result useless."""
    text: Text
    """Description of the problem."""
    mend: Text | None
    """Remedy; null: none, or `text` has it."""
    law: Text | None
    """Friction model of the package with the missing term; null: the problem is not a missing term, or no model has
    it."""


class SuggestedCommand(Record):
    """A command to copy."""

    kind: Literal["repair", "inspect", "law", "recording", "export"]
    """Purpose: fix a finding, inspect the recordings, try another friction model, design the next recording, or export
    the drive."""
    command: Text
    """Shell command."""


class Verdict(Record):
    """Problems of a result, and next steps."""

    grade: Grade
    """Overall grade."""
    findings: list[ResultFinding]
    """Problems, causes first and then severe ones; empty: no problem found."""
    commands: list[SuggestedCommand]
    """Commands to copy, in this order. A result that must not be used gets no recording and no export; a result with a
    repair gets no recording."""
