"""What `result.json` holds of how a run went, as types."""

from typing import Annotated, Literal, TypedDict

from frictionzoo.result.kinds import Count, Natural, NotNegative, Positive, Text


class FitRow(TypedDict):
    """How the parameters were found."""

    method: str
    """The optimiser: adam, lm or grid."""
    iterations: Natural
    """Iterations that were made; for a grid, its points."""
    best_iteration: Natural
    """The iteration whose values are reported: that of the lowest loss on the whole training set."""
    loss: float | None
    """Loss of that iteration, weighted as configured."""
    stopped: Text
    """Why the fit ended: converged, finished (all iterations made), patience, or diverged."""
    falling: NotNegative
    """Share of the lowest loss that the last tenth of the iterations took off; 0 where it converged by itself."""
    moving: list[str]
    """Parameters, as `owner.name`, of several joints `owner.name/JOINT`, that still moved in the last tenth of the
    iterations: by more than a third of half their interval, or 1 % of their value where they have none."""


class ChoiceRow(TypedDict):
    """An option that was left open."""

    option: Text
    """Its dotted name."""
    value: float | bool | str | list[float] | None
    """What was chosen."""
    reason: Text
    """Why."""


class PairedRow(TypedDict):
    """One joint's columns."""

    joint: Text
    """Its name."""
    columns: dict[str, str]
    """Header of its column of each signal: `qpos`, `ctrl`, and others that were recorded. A column that serves all
    joints stands with each of them."""


class ColumnsRow(TypedDict):
    """Logs with the same headers, and which column each joint got."""

    logs: Annotated[list[str], ("minItems", 1)]
    """Their names, as in `data.logs`."""
    by: dict[str, Literal["name", "listed", "place"]]
    """How the columns of each signal were matched. `name`: the headers name the joints. `listed`: the order of
    `data.columns` counts. `place`: the headers have no names, and their order counts."""
    joints: Annotated[list[PairedRow], ("minItems", 1)]
    """Each joint, in the order of `joints`."""


class TimingRow(TypedDict):
    """Wall-clock seconds."""

    setup: NotNegative
    """Reading or making data, building bench and model, and finding what was left open of the settings."""
    compile: NotNegative
    """Compiling the fit's rollouts."""
    fit: NotNegative
    """The fit without compiling."""
    uncertainty: NotNegative
    """The intervals of the parameters, with compiling."""
    evaluate: NotNegative
    """The rollouts of the evaluation."""
    total: NotNegative
    """From the start of the run to this file."""


class ProofRow(TypedDict):
    """How far the engine is from MuJoCo C."""

    step: NotNegative
    """Largest difference of a position or velocity after one step [rad or m, rad/s or m/s], relative where they are
    above 1."""
    rollout: NotNegative
    """The same after all steps."""
    cases: Count
    """Rollouts."""
    steps: Count
    """Steps in each."""


class WrittenRow(TypedDict):
    """A model file that the run left behind, played in MuJoCo C beside the identified drive.

    It is loaded as it is: its time step, integrator, actuators and their delay are those of the file, and `ctrl` is the
    recorded command. A robot's own file is played on the bench's stand: base and other joints stand still, contacts and
    limits act where the bench has them.
    """

    file: Text
    """Its name in the run's folder."""
    timestep: Positive
    """Its time step [s]."""
    mean: NotNegative | None
    """Mean absolute difference of positions from the identified drive's in the long test rollouts [unit]; null where it
    was not played, and `limits` say why."""
    largest: NotNegative | None
    """Largest absolute difference of positions [unit]."""
    unit: Literal["rad", "m"]
    """Unit of the differences."""
    share: NotNegative | None
    """`mean` as a share of the drive's own error, `metrics.test.position_mae`."""
    exact: bool
    """Whether the largest difference is rounding: at most 1e-9."""
    over: str
    """The rollouts, in words; empty where there were none."""
    reason: str
    """In a few words, why it moves differently; empty where it should not."""
    limits: list[Text]
    """What the file cannot hold and what its user has to know, a sentence each."""


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
