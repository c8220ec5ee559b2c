"""Types of the parts of `result.json` that describe the run."""

from typing import Annotated, Literal, TypedDict

from frictionzoo.result.kinds import Count, Natural, NotNegative, Positive, Text

FAR = 0.1  # share of the drive's error; larger differences of a model file are marked


class FitRow(TypedDict):
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


class ChoiceRow(TypedDict):
    """An option set automatically."""

    option: Text
    """Dotted name of the option."""
    value: float | bool | str | list[float] | None
    """Chosen value."""
    reason: Text
    """Reason for the choice."""


class PairedRow(TypedDict):
    """Columns of one joint."""

    joint: Text
    """Name of the joint."""
    columns: dict[str, str]
    """Column header for each signal: `qpos`, `ctrl` and other recorded signals. A column that serves all joints is
    listed for each of them."""


class ColumnsRow(TypedDict):
    """Logs with the same headers, and the columns of each joint."""

    logs: Annotated[list[str], ("minItems", 1)]
    """Names of the logs, as in `data.logs`."""
    by: dict[str, Literal["name", "listed", "place"]]
    """Matching of the columns of each signal. `name`: the headers name the joints. `listed`: the order of
    `data.columns` counts. `place`: the headers do not name the joints, and the order of the columns counts."""
    joints: Annotated[list[PairedRow], ("minItems", 1)]
    """Columns of each joint, in the order of `joints`."""


class TimingRow(TypedDict):
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


class ProofRow(TypedDict):
    """Difference between the engine and MuJoCo C."""

    step: NotNegative
    """Largest difference of a position or velocity after one step [rad or m, rad/s or m/s]; relative for values above
    1."""
    rollout: NotNegative
    """The same after all steps."""
    cases: Count
    """Number of rollouts."""
    steps: Count
    """Steps in each rollout."""


class WrittenRow(TypedDict):
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


Versions = TypedDict(
    "Versions",
    {
        "frictionzoo": str,
        "python": str,
        "mujoco": str,
        "mujoco-mjx": str,
        "jax": str,
        "torch": str,
        "optax": str,
        "lightning": str,
        "numpy": str,
    },
)
