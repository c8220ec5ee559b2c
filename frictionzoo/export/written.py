"""What came of an export: files, how far they are from the drive, and what they cannot represent."""

from dataclasses import dataclass
from pathlib import Path

FAR = 0.1  # of the drive's own error; a target that moves otherwise by more is marked


@dataclass(frozen=True)
class Difference:
    """What was written, run in the program that it is for, against the fitted drive.

    Attributes:
        quantity: What was compared: `qpos`, or `torque`.
        unit: Its unit.
        largest: Largest absolute difference.
        mean: Mean absolute difference.
        over: Of what, in words: `10 rollouts of 3 s`.
        reason: In a few words, what the target lacks of the drive; empty where it should move as that.
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
    """What a target wrote.

    Attributes:
        files: Their names in the folder.
        differences: Measured by running the written files.
        limits: What they cannot represent and what a user has to know, a sentence each, with its loss of accuracy.
    """

    files: tuple[str, ...]
    differences: tuple[Difference, ...]
    limits: tuple[str, ...] = ()


@dataclass(frozen=True)
class Written:
    """One target's outcome.

    Attributes:
        target: Its name.
        folder: Where the files are; None where there are none.
        export: What was written; None where nothing was.
        reason: Why nothing was written, in one line.
        error: Mean absolute position error of the drive itself in the run's test rollouts; None where it has none.
    """

    target: str
    folder: Path | None = None
    export: Export | None = None
    reason: str = ""
    error: float | None = None

    def share(self, difference: Difference) -> float | None:
        """The mean difference of positions over the drive's own error; None where there is no such."""
        return difference.mean / self.error if difference.quantity == "qpos" and self.error else None

    def is_far(self, difference: Difference) -> bool:
        """Whether what was written moves otherwise than the drive by more than a tenth of the drive's own error."""
        share = self.share(difference)
        return share is not None and not share <= FAR

    def mark(self, difference: Difference) -> str:
        """What a row of the difference says at its end: empty, or that it is far, by how much and why."""
        if not self.is_far(difference):
            return ""
        reason = difference.reason or "for no known reason: do not use it"
        return f"far from the drive, {self.share(difference):.0%} of its own error: {reason}"
