"""Runs on the same data side by side: which friction law to take, and how sure that is."""

from frictionzoo.compare.comparison import Comparison, compare_runs, read_schema
from frictionzoo.compare.files import write_comparison
from frictionzoo.compare.runs import Failure, Run, read_runs

__all__ = ["Comparison", "Failure", "Run", "compare_runs", "read_runs", "read_schema", "write_comparison"]
