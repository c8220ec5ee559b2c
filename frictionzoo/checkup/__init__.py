"""Diagnostics of recordings and their bench before a fit."""

from frictionzoo.checkup.findings import CHECKUPS, Finding
from frictionzoo.checkup.recordings import check_up, find_all

__all__ = ["CHECKUPS", "Finding", "check_up", "find_all"]
