"""What is in a data set, before any fit: `python -m frictionzoo.inspect data=...`."""
