"""Runs on the same data side by side: which friction law to take, and how sure that is."""

from frictionzoo.comparison.files import write_comparison
from frictionzoo.comparison.record import compare_runs, read_schema
from frictionzoo.comparison.runs import Failure, Run, find_runs, read_failure, read_runs
from frictionzoo.comparison.types import Comparison

__all__ = [
    "Comparison",
    "Failure",
    "Run",
    "compare_runs",
    "find_runs",
    "read_failure",
    "read_runs",
    "read_schema",
    "write_comparison",
]
