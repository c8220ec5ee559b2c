"""Diagnostics of recordings and their bench before a fit."""

from frictionzoo.diagnostics.findings import CHECKUPS, Finding
from frictionzoo.diagnostics.recordings import check_up, find_all

__all__ = ["CHECKUPS", "Finding", "check_up", "find_all"]
