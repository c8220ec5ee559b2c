"""Experiment design, the next command to record: `python -m frictionzoo.design velocity=4 torque=2 position=1.5`."""
