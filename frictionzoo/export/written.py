"""Outcome of an export: files, their difference from the drive, and their limits."""

from dataclasses import dataclass
from pathlib import Path

from frictionzoo.result.run_types import FAR


@dataclass(frozen=True)
class Difference:
    """Absolute difference between the written files, run in their program, and the fitted drive.

    Attributes:
        quantity: `qpos` or `torque`.
        over: The compared data, in words: `10 rollouts of 3 s`.
        reason: Reason for a difference, in a few words; empty if no difference is expected.
        error: Mean absolute position error against the recordings; None if not measured.
    """

    quantity: str
    unit: str
    largest: float
    mean: float
    over: str
    reason: str = ""
    error: float | None = None


@dataclass(frozen=True)
class Export:
    """Files written by a target, their measured differences from the drive, and their limits, a sentence each."""

    files: tuple[str, ...]
    differences: tuple[Difference, ...]
    limits: tuple[str, ...] = ()


@dataclass(frozen=True)
class Written:
    """Outcome of one target: its `export`, or None and the reason.

    Attributes:
        reason: Reason why nothing was written, in one line.
        error: Mean absolute position error of the drive in the run's test rollouts; None if unknown.
    """

    target: str
    folder: Path | None = None
    export: Export | None = None
    reason: str = ""
    error: float | None = None

    def share(self, difference: Difference) -> float | None:
        """Return the mean position difference as a share of the drive's error; None if unknown."""
        return difference.mean / self.error if difference.quantity == "qpos" and self.error else None

    def is_far(self, difference: Difference) -> bool:
        """Return whether the mean position difference exceeds a tenth of the drive's error."""
        share = self.share(difference)
        return share is not None and not share <= FAR

    def mark(self, difference: Difference) -> str:
        """Return the mark in a difference's row: empty, or size and reason of a large difference."""
        if not self.is_far(difference):
            return ""
        reason = difference.reason or "for no known reason: do not use it"
        return f"far from the drive, {self.share(difference):.0%} of its own error: {reason}"
