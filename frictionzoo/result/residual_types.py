"""Types of the residual analysis in `result.json`."""

from typing import Annotated, Literal, TypedDict

from frictionzoo.result.kinds import Count, NotNegative, Positive, Text


class PlaceRow(TypedDict):
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
    motion; `pull`: position, alike in both directions, which is not friction; `temperature`: temperature; `reversal`:
    time since the last reversal of the motion; `gap`: time around sign changes of the motor torque, as from
    backlash."""
    value: float | None
    """Estimated value: the constant torque or the limit [unit], the factor of the actuator torque, or the delay [s];
    null: no single value."""
    periods: Positive | None
    """Periods of a ripple over the position, as in the model `ripple`: per turn on a hinge, 2 pi / period [1/m] on a
    slide; null: no ripple."""
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


class JointResidualRow(TypedDict):
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
    places: Annotated[list[PlaceRow], ("maxItems", 3)]
    """Significant residual factors, largest share first; empty: no tested factor explains the residual torque."""


class ResidualRow(TypedDict):
    """Residual torque under the training commands."""

    unit: Literal["N m", "N"]
    """Unit of all torques or forces in this section."""
    bandwidth: Positive
    """Bandwidth of the analysis [Hz]: as in `torque`, or lower if encoder noise dominates."""
    by_joint: list[JointResidualRow]
    """Residual analysis of each joint that moves enough."""
