"""Comparison of runs on the same data: which friction model to use, and how certain the ranking is."""
