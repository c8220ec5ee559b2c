"""What `result.json` holds of recorded torque and of link inertia that is found by it, as types."""

from typing import Annotated, Literal, TypedDict

from frictionzoo.result.kinds import Moments, Natural, NotNegative, Positive, Text, Vector


class TorqueErrorsRow(TypedDict):
    """Root mean squares over all compared samples of one part, of one joint, or their mean over the joints [unit].

    null: it is not finite.
    """

    residual: NotNegative | None
    """Of the torque that is left: the drive's less what armature, friction and the links need for the motion."""
    torque: NotNegative | None
    """Of the drive's torque itself."""


class TorquePartsRow(TypedDict):
    """The mean over the joints on each part of the data."""

    train: TorqueErrorsRow
    """On the logs that the fit saw."""
    test: TorqueErrorsRow
    """On the logs that it did not see."""


class JointTorqueRow(TypedDict):
    """One joint on each part of the data."""

    joint: Text
    """Its name."""
    train: TorqueErrorsRow
    """On the logs that the fit saw."""
    test: TorqueErrorsRow
    """On the logs that it did not see."""


class TorqueRow(TypedDict):
    """What is left of recorded torque, joint by joint."""

    compared: Literal["torque", "ctrl"]
    """What is the drive's torque. torque: that recorded beside the command, at its instant and as it is; the actuator
    law and its offsets have no part in it. ctrl: the command of a torque drive by its actuator law, with the final
    gain, offset, limits and delay."""
    unit: Literal["N m", "N"]
    """Unit of the torques."""
    bandwidth: Positive
    """Frequency up to which torques are compared [Hz]; see `evaluation.torque`."""
    held: bool
    """Whether the command acts until the next sample; if not, at its instant alone, as measured torque does."""
    mean: TorquePartsRow
    """Mean over the joints."""
    by_joint: Annotated[list[JointTorqueRow], ("minItems", 1)]
    """The same joint by joint, in the order of `joints`."""


class InertiaRow(TypedDict):
    """A body's inertia."""

    mass: Positive
    """[kg]"""
    centre: Vector
    """Centre of mass x, y, z in the body's frame [m]."""
    inertia: Moments
    """About the centre, along the axes of the frame: ixx, iyy, izz, ixy, ixz, iyz [kg m^2]."""


class LinkRow(TypedDict):
    """A link whose inertia was identified along."""

    body: Text
    """Its name."""
    found: InertiaRow
    """As identified: pulled towards the maker's, and that of a body of matter."""
    maker: InertiaRow
    """As the model file has it."""
    prior_only: list[str]
    """Which of its parameters m, mx, my, mz [kg, kg m], Ixx, Iyy, Izz, Ixy, Ixz, Iyz [kg m^2, about the frame's origin]
    the data say nothing of, or only in combinations that they do not determine: those are the prior's."""


class BaseRow(TypedDict):
    """A base parameter: a combination of parameters of links, armatures and whatever else acts on torque."""

    combination: Text
    """Its parameters; the first is the one it is named after."""
    value: float
    """In SI units."""
    error: NotNegative | None
    """Standard error by the data alone; null: infinite."""
    determined: bool
    """Whether the data give it its value, and not the prior: the error is below a third of the prior's deviation, or of
    the value where that has no prior."""


class GravityRow(TypedDict):
    """Gravity in the frame of the base, as strong as the model file has it."""

    found: Vector
    """As identified [m/s^2]."""
    maker: Vector
    """As the model file has it [m/s^2]."""
    angle: NotNegative
    """Between the two: how far the base stands askew [rad]."""
    error: NotNegative | None
    """Standard error of the angle, with the links' prior, the larger of two directions' [rad]; null: infinite."""


class LinksRow(TypedDict):
    """Inertias of links, and gravity, that were identified along, before all else."""

    links: list[LinkRow]
    """What was found of each; all that follows in the run takes it for known."""
    gravity: GravityRow | None
    """Gravity that was found along (`fit.tilt`), known from then on likewise; null: it is the model file's."""
    determined: Natural
    """How many base parameters the data determine."""
    base: list[BaseRow]
    """All that torque can tell of the links and of what was identified with them; parameters in none of them have no
    effect."""
