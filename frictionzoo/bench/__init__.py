"""Benches: the MJCF around a drive, and the actuator laws that turn commands into torque."""

from frictionzoo.bench.actuators import Actuator, Affine, Force, PositionPD
from frictionzoo.bench.base import Bench

__all__ = ["Actuator", "Affine", "Bench", "Force", "PositionPD"]
