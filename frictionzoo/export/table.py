"""What was exported, as one table in plain text."""

from collections.abc import Sequence

from frictionzoo.export.written import Written
from frictionzoo.show.terminal import align


def summarise_exports(written: Sequence[Written]) -> str:
    """One row a comparison, then what each target cannot represent, and where the files are.

    Args:
        written: What each target wrote, or why it wrote nothing.
    """
    rows = [("target", "compared", "over", "largest difference", "mean", "limits", "")]
    rows += [row for one in written for row in _rows(one)]
    limits = [f"{one.target}: {limit}" for one in written if one.export for limit in one.export.limits]
    reasons = [f"{one.target}: nothing written: {one.reason}" for one in written if one.export is None]
    files = [f"files: {one.folder}" for one in written if one.folder]
    return "\n\n".join("\n".join(block) for block in ([align(rows)], limits, reasons, files) if block)


def _rows(one: Written) -> list[tuple[str, ...]]:
    if one.export is None:
        return [(one.target, "", "", "", "", "not written", "")]
    limits = str(len(one.export.limits) or "none")
    return [
        (
            one.target,
            f"{difference.quantity} [{difference.unit}]",
            difference.over,
            f"{difference.largest:.2g}",
            f"{difference.mean:.2g}",
            limits,
            "far from the drive: by over a tenth of its own error" if one.is_far(difference) else "",
        )
        for difference in one.export.differences
    ]
