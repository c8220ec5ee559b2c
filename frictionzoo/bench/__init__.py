"""Benches: the MJCF around a drive, and the actuator laws that turn commands into torque."""

from frictionzoo.bench.actuators import Actuator, Affine, DcMotorPD, Force, PositionPD, VoltageServo
from frictionzoo.bench.base import Bench
from frictionzoo.bench.channels import Channels

__all__ = ["Actuator", "Affine", "Bench", "Channels", "DcMotorPD", "Force", "PositionPD", "VoltageServo"]
