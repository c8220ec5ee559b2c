"""frictionzoo: a drive's armature and friction from its encoder log, through a differentiable MuJoCo."""

__version__ = "0.1.0"
