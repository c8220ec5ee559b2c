"""Runs and sweeps while they run, from the files that they leave: `python -m frictionzoo.watch FOLDER`."""
