"""Conversion of a robot's model file, MJCF or URDF, for a bench."""

from frictionzoo.bench.robot_file.controllers import ReadActuator
from frictionzoo.bench.robot_file.read import RobotFile, read_robot
from frictionzoo.bench.robot_file.source import look_at

__all__ = ["ReadActuator", "RobotFile", "look_at", "read_robot"]
