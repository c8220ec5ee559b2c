"""Conversion of a robot's model file, MJCF or URDF, for a bench."""

from frictionzoo.bench.robot_file.actuator import ReadActuator
from frictionzoo.bench.robot_file.links import Link
from frictionzoo.bench.robot_file.read import RobotFile, read_robot
from frictionzoo.bench.robot_file.source import look_at

__all__ = ["Link", "ReadActuator", "RobotFile", "look_at", "read_robot"]
