"""The command to record next: `python -m frictionzoo.excite velocity=4 torque=2 position=1.5`."""
