"""Several drives side by side, in one object."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from frictionzoo.comparison.files import save_comparison
from frictionzoo.comparison.record import compare_runs
from frictionzoo.comparison.runs import Failure, Run, gather
from frictionzoo.comparison.types import Comparison, PairRow
from frictionzoo.core.errors import RunError
from frictionzoo.result.identified import Identified


@dataclass(frozen=True, eq=False, repr=False)
class Compared:
    """Drives that were identified on the same recordings and judged on the same rollouts.

    Attributes:
        record: What `comparison.json` holds.
        runs: The runs that were compared.
        drives: The drives by label, best first.
    """

    record: Comparison
    runs: tuple[Run, ...]
    drives: Mapping[str, Identified]

    @classmethod
    def of(cls, drives: Sequence[Identified], failures: Sequence[Failure] = ()) -> "Compared":
        """Compare drives, and list what has none.

        Raises:
            RunError: There is none, or they were not judged on the same rollouts of the same recordings.
        """
        if not drives:
            raise RunError("drives: none, expected at least one to compare")
        runs = gather([Run(d.result["model"], Path(d.folder or d.result["model"]), d.result, d.curves) for d in drives])
        labelled = dict(zip((run.label for run in runs), drives, strict=True))
        record = compare_runs(runs, failures)
        return cls(record, tuple(runs), {row["label"]: labelled[row["label"]] for row in record["runs"]})

    @property
    def ranking(self) -> list[str]:
        """Labels of the drives, the one with the lowest position error on test data first."""
        return list(self.drives)

    @property
    def recommended(self) -> Identified | None:
        """The simplest drive within noise of the best; None where all lost all rollouts."""
        recommendation = self.record["recommendation"]
        return self.drives[recommendation["run"]] if recommendation else None

    @property
    def differences(self) -> dict[tuple[str, str], PairRow]:
        """How much worse the first of two is than the second, in paired rollouts: mean, 95 % interval, verdict."""
        return {(pair["run"], pair["other"]): pair for pair in self.record["pairs"]}

    def save(self, folder: str | Path) -> None:
        """Write what `python -m frictionzoo.compare` writes: record, page, figures, and a table for a paper.

        Raises:
            OutputError: It cannot be written.
        """
        save_comparison(self.record, self.runs, Path(folder))

    def __repr__(self) -> str:
        """The drives best first, what failed, and the recommendation."""
        from frictionzoo.show.terminal import summarise_comparison

        return summarise_comparison(self.record, None)

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        from frictionzoo.show.terminal import summarise_comparison_in_html

        return summarise_comparison_in_html(self.record, None)
