"""A fitted drive's nearest one with a simpler law: `python -m frictionzoo.distill RUN model=NAME`."""
