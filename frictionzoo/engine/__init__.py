"""Engines: one simulation step of a bench, differentiable in its parameters."""

from frictionzoo.engine.mjx import MjxEngine

__all__ = ["MjxEngine"]
