"""What `result.json` holds of the torque that is left, and whether that is noise, as types."""

from typing import Annotated, Literal, TypedDict

from frictionzoo.result.kinds import Count, NotNegative, Positive, Text


class PlaceRow(TypedDict):
    """Something of the motion that goes with the torque that is left."""

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
    """What it changes with: nothing, a `constant` torque; `scale`, the torque that the motion needs; `limit`, what the
    commands ask for beyond a limit; `late`, the rate of the actuator's torque; the speed; `slow`, low speeds; `fast`,
    high ones; the direction; the load on the gear; the position, against the motion; `pull`, the position, alike in
    both directions, which is no friction; the temperature; `reversal`, the time since the motion last turned round;
    `gap`, the time around changes of the motor's direction."""
    value: float | None
    """What explains it: the constant torque or the limit [unit], the factor of the actuator's torque, or the delay [s];
    null: no one number does."""
    periods: Positive | None
    """Of a ripple over the position, as the law `ripple` has them: on a hinge, periods in a turn. null: it is none."""
    share: float
    """Share of the variance that is left, in stretches of time that were held out, beyond the places before it and
    beyond what it explains where nothing is wrong."""
    torque: NotNegative
    """Root mean square of that part [unit]."""
    chance: float
    """Probability that noise scores as high in any of the places of any joint, at most."""
    known: bool
    """The law has a term for it already, of another form or at a bound."""
    law: Text | None
    """The law of the zoo that has such a term; null: none has."""
    whole: bool
    """That law has all terms of the present one, too."""


class JointResidualRow(TypedDict):
    """What is left of the torque of a joint while it moves."""

    joint: Text
    """Its name."""
    rows: Count
    """How many torques count."""
    residual: NotNegative
    """Root mean square of what is left [unit]."""
    noise: NotNegative
    """The same where nothing is wrong [unit]: of the identified drive, simulated under the same commands and measured
    by an encoder with the same step and noise; where that moves otherwise, what such noise makes of the recording."""
    friction: NotNegative
    """The same of the friction: the law's, and what is left [unit]."""
    correlation: float
    """Correlation of neighbours in time of what is left."""
    noise_correlation: float
    """The same of the noise."""
    kurtosis: float
    """Excess kurtosis of what is left; 0 of normal noise."""
    places: Annotated[list[PlaceRow], ("maxItems", 3)]
    """What it goes with by more than chance, the largest share first; empty: nothing that was looked for."""


class ResidualRow(TypedDict):
    """What is left of the torque that the actuators give under the training commands."""

    unit: Literal["N m", "N"]
    """Of all torques or forces here."""
    bandwidth: Positive
    """Frequency up to which they are compared [Hz]: that of `torque`, or lower where noise drowns the rest."""
    by_joint: list[JointResidualRow]
    """Of each joint that moves enough."""
