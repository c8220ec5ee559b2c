"""Outcome of an export: files, their distance from the drive, and what they cannot represent."""

from dataclasses import dataclass
from pathlib import Path

FAR = 0.1  # share of the drive's own error; larger differences are marked


@dataclass(frozen=True)
class Difference:
    """Difference between the written files, run in their program, and the fitted drive.

    Attributes:
        quantity: The compared quantity: `qpos`, or `torque`.
        unit: Its unit.
        largest: Largest absolute difference.
        mean: Mean absolute difference.
        over: The compared data, in words: `10 rollouts of 3 s`.
        reason: What the target lacks of the drive, in a few words; empty where it should move as the drive.
        error: Mean absolute position error against the recordings; None where that was not measured.
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
    """Files that a target wrote.

    Attributes:
        files: Their names in the folder.
        differences: Differences from the drive, measured by running the files.
        limits: What they cannot represent and what a user has to know, a sentence each, with the loss of accuracy.
    """

    files: tuple[str, ...]
    differences: tuple[Difference, ...]
    limits: tuple[str, ...] = ()


@dataclass(frozen=True)
class Written:
    """Outcome of one target.

    Attributes:
        target: Its name.
        folder: Folder of the files; None where there are none.
        export: The written files; None where nothing was written.
        reason: Why nothing was written, in one line.
        error: Mean absolute position error of the drive itself in the run's test rollouts; None where that is unknown.
    """

    target: str
    folder: Path | None = None
    export: Export | None = None
    reason: str = ""
    error: float | None = None

    def share(self, difference: Difference) -> float | None:
        """Return the mean difference of positions over the drive's own error; None where that is unknown."""
        return difference.mean / self.error if difference.quantity == "qpos" and self.error else None

    def is_far(self, difference: Difference) -> bool:
        """Return whether the files move differently than the drive by more than a tenth of its own error."""
        share = self.share(difference)
        return share is not None and not share <= FAR

    def mark(self, difference: Difference) -> str:
        """Return the end of a difference's row: empty, or by how much the files are far and why."""
        if not self.is_far(difference):
            return ""
        reason = difference.reason or "for no known reason: do not use it"
        return f"far from the drive, {self.share(difference):.0%} of its own error: {reason}"
