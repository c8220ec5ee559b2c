"""Outcome of an export: files, their difference from the drive, and their limits."""

from dataclasses import dataclass
from pathlib import Path

from frictionzoo.result.run_types import FAR


@dataclass(frozen=True)
class Difference:
    """Difference between the written files, run in their program, and the fitted drive.

    Attributes:
        quantity: The compared quantity: `qpos`, or `torque`.
        unit: Its unit.
        largest: Largest absolute difference.
        mean: Mean absolute difference.
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
    """Files written by a target.

    Attributes:
        files: Their names in the folder.
        differences: Differences from the drive, measured by running the files.
        limits: Limits of the files and remarks for users, a sentence each, with the loss of accuracy.
    """

    files: tuple[str, ...]
    differences: tuple[Difference, ...]
    limits: tuple[str, ...] = ()


@dataclass(frozen=True)
class Written:
    """Outcome of one target.

    Attributes:
        target: Name of the target.
        folder: Folder of the files; None if there are none.
        export: The written files; None if nothing was written.
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
