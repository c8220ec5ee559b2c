"""`Compared`: drives identified on the same data, with ranking and recommendation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from frictionzoo.api.comparison_files import save_comparison
from frictionzoo.api.identified import Identified
from frictionzoo.core.errors import RunError
from frictionzoo.result.comparison.record import compare_runs
from frictionzoo.result.comparison.runs import Failure, Run, gather
from frictionzoo.result.comparison.types import Comparison, Pair


@dataclass(frozen=True, eq=False, repr=False)
class Compared:
    """Drives identified on the same recordings and evaluated on the same rollouts.

    Attributes:
        record: Content of `comparison.json`.
        runs: The compared runs.
        drives: The drives by label, best first; for several seeds, the drive with the lowest training error.
    """

    record: Comparison
    runs: tuple[Run, ...]
    drives: Mapping[str, Identified]

    @classmethod
    def of(cls, drives: Sequence[Identified], failures: Sequence[Failure] = ()) -> "Compared":
        """Compare drives and list failed fits.

        Raises:
            RunError: There is no drive, or data or evaluation rollouts differ.
        """
        if not drives:
            raise RunError("drives: none, expected at least one to compare")
        runs = gather([Run(d.result.model, Path(d.folder or d.result.model), d.result, d.curves) for d in drives])
        by_result = {id(drive.result): drive for drive in drives}
        labelled = {run.label: by_result[id(run.by_seed[0].result)] for run in runs}
        record = compare_runs(runs, failures)
        return cls(record, tuple(runs), {row.label: labelled[row.label] for row in record.runs})

    @property
    def ranking(self) -> list[str]:
        """Labels of the drives, best first: fewest diverged test rollouts, then lowest position error."""
        return list(self.drives)

    @property
    def recommended(self) -> Identified | None:
        """The simplest drive within noise of the best, identifiable ones first; None if all test rollouts diverged."""
        recommendation = self.record.recommendation
        return self.drives[recommendation.run] if recommendation else None

    @property
    def differences(self) -> dict[tuple[str, str], Pair]:
        """Error of the first drive minus error of the second on paired rollouts: mean, 95 % interval, verdict."""
        return {(pair.run, pair.other): pair for pair in self.record.pairs}

    def save(self, folder: str | Path, font: Literal["sans", "serif"] = "sans") -> None:
        """Write the files of `python -m frictionzoo.compare`: JSON, page, figures, and a LaTeX table.

        Args:
            folder: Output folder.
            font: Font of the PDF figures.

        Raises:
            ConfigError: The font is another one.
            OutputError: A file cannot be written.
        """
        save_comparison(self.record, self.runs, Path(folder), font)

    def __repr__(self) -> str:
        """Return drives (best first), failures and recommendation as text."""
        from frictionzoo.report.terminal import summarise_comparison

        return summarise_comparison(self.record, None)

    def _repr_html_(self) -> str:
        from frictionzoo.report.terminal import summarise_comparison_in_html

        return summarise_comparison_in_html(self.record, None)
