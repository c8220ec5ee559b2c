"""Distillation of a fitted drive into one with a simpler friction model: `python -m frictionzoo.distill`."""
