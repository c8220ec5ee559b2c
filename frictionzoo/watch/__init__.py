"""Progress of runs and sweeps, read from their files: `python -m frictionzoo.watch FOLDER`."""
