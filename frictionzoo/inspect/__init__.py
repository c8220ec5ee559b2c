"""Diagnostics of a data set before a fit: `python -m frictionzoo.inspect data=...`."""
