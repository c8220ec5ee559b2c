"""Command lines: run, compare, inspect, export and distil."""
