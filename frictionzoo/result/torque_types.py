"""Types of recorded torque and of link inertias estimated from it in `result.json`."""

from typing import Annotated, Literal, TypedDict

from frictionzoo.result.kinds import Moments, Natural, NotNegative, Positive, Text, Vector


class TorqueErrorsRow(TypedDict):
    """Root mean squares over all compared samples of one part, for one joint or as the mean over the joints [unit].

    null: not finite.
    """

    residual: NotNegative | None
    """Residual torque: the drive's torque minus the torque that armature, friction and links need for the motion."""
    torque: NotNegative | None
    """The drive's torque."""


class TorquePartsRow(TypedDict):
    """Mean over the joints on each part of the data."""

    train: TorqueErrorsRow
    """Torques on the training logs."""
    test: TorqueErrorsRow
    """Torques on the test logs."""


class JointTorqueRow(TypedDict):
    """Torques of one joint on each part of the data."""

    joint: Text
    """Name of the joint."""
    train: TorqueErrorsRow
    """Torques on the training logs."""
    test: TorqueErrorsRow
    """Torques on the test logs."""


class TorqueRow(TypedDict):
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
    mean: TorquePartsRow
    """Mean over the joints."""
    by_joint: Annotated[list[JointTorqueRow], ("minItems", 1)]
    """The same for each joint, in the order of `joints`."""


class InertiaRow(TypedDict):
    """Inertia of a body."""

    mass: Positive
    """Mass [kg]."""
    centre: Vector
    """Centre of mass x, y, z in the body's frame [m]."""
    inertia: Moments
    """Inertia about the centre of mass, along the axes of the body's frame: ixx, iyy, izz, ixy, ixz, iyz [kg m^2]."""


class LinkRow(TypedDict):
    """A link with estimated inertia."""

    body: Text
    """Name of the body."""
    found: InertiaRow
    """Estimated inertia; physically consistent, with the model file's inertia as the prior."""
    maker: InertiaRow
    """Inertia in the model file."""
    prior_only: list[str]
    """Parameters of the link that the data do not determine, alone or in combination; their values come from the prior.
    Symbols: m [kg], mx, my, mz [kg m], Ixx, Iyy, Izz, Ixy, Ixz, Iyz [kg m^2, about the frame's origin]."""


class BaseRow(TypedDict):
    """A base parameter: a combination of parameters of links, armatures and other torque terms."""

    combination: Text
    """The combination in words; its first parameter gives it its name."""
    value: float
    """Value in SI units."""
    error: NotNegative | None
    """Standard error from the data alone, without the prior; null: infinite."""
    determined: bool
    """Whether the data, not the prior, determine the value: the standard error is below a third of the prior's standard
    deviation, or of the value if it has no prior."""


class GravityRow(TypedDict):
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


class LinksRow(TypedDict):
    """Link inertias and gravity, estimated before the fit."""

    links: list[LinkRow]
    """Estimated inertia of each link; the rest of the run treats it as known."""
    gravity: GravityRow | None
    """Estimated gravity (`fit.tilt`); the rest of the run treats it as known. null: gravity of the model file."""
    determined: Natural
    """Number of base parameters determined by the data."""
    base: list[BaseRow]
    """All base parameters that torque can determine, of the links and of the parameters estimated with them; parameters
    in none of them have no effect."""
