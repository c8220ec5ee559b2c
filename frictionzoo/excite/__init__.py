"""Experiment design, the next command to record: `python -m frictionzoo.excite velocity=4 torque=2 position=1.5`."""
