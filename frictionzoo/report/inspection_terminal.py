"""Summary of a data set in plain text."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from frictionzoo.core.telling import align, escape_all, list_columns
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.diagnostics.survey_findings import merge_findings
from frictionzoo.report.inspection_tables import format_short, judge, list_quantities, tabulate_checks

WIDTH = 110  # characters per line, at most, and without a terminal
STATES = {"good": "ok", "note": "note", "caution": "caution", "bad": "problem"}
MARKS = {"good": " ", "note": "i", "caution": "!", "bad": "x"}  # in the table of joints


def summarise(survey: Mapping[str, Any], folder: Path | None, command: str = "") -> str:
    """Summarise a data set: quantities, findings, verdict, folder of its files if any, and the `command` to run next.

    Several joints have one row each, with the results of the checks in which they differ.
    """
    survey = escape_all(survey)
    data, count, first = survey["data"], survey["data"]["recordings"], survey["joints"][0]
    length, findings = f"{data['samples']} samples, {data['duration']:.4g} s", merge_findings(survey)
    if len(survey["joints"]) > 1:
        named = all(by == "name" for columns in survey["columns"] for by in columns["by"].values())
        tables = [
            *([] if named else [align(list_columns(columns)) for columns in survey["columns"]]),
            _tabulate(survey),
        ]
    else:
        head = ("over all recordings", "lowest", "median", "highest", "unit")
        tables = [align([head, *list_quantities(survey), *list_quantities(survey, first["name"])])]
    blocks = [
        f"{data['name']}: {count} recording{'s' * (count != 1)}, {length}",
        *tables,
        "\n".join(_tell(findings, brief=len(survey["joints"]) > 1)),
        fill(judge(survey), _width()),
        *([f"files: {folder}" + (f"\nnext:\n  {command}" if command else "")] if folder else []),
    ]
    return "\n\n".join(blocks)


def _tabulate(survey: Mapping[str, Any]) -> str:
    columns, units = [column for column in tabulate_checks(survey) if column.differs], survey["units"]
    head = (f"position [{units['position']}]", f"top speed [{units['velocity']}]")
    rows = [("joint", *head, *(column.heading for column in columns))]
    for number, joint in enumerate(survey["joints"]):
        low, high = map(format_short, joint["position"])
        cells = [column.cells[number] for column in columns]
        marked = [f"{cell.value} {MARKS[cell.state]}" for cell in cells]
        rows.append((joint["name"], f"{low} to {high}", format_short(max(map(abs, joint["velocity"]))), *marked))
    used = {cell.state for column in columns for cell in column.cells} - {"good"}
    legend = ", ".join(f"{MARKS[state]} {STATES[state]}" for state in STATES if state in used)
    return align(rows) + (f"\n({legend})" if legend else "")


def _tell(findings: Sequence[Finding], brief: bool) -> Iterator[str]:
    """Yield one paragraph per finding; if `brief`, one for all checks that every joint passed."""
    told = [finding for finding in findings if not brief or finding.state != "good"]
    lines = [(finding.state, f"{finding.title}: {finding.text}", finding.option) for finding in told]
    failed = {finding.title.partition(",")[0] for finding in told}
    passed = dict.fromkeys(finding.title.partition(",")[0] for finding in findings)
    if brief and passed.keys() - failed:
        lines.append(("good", f"{', '.join(check for check in passed if check not in failed)}.", None))
    for state, text, option in lines:
        text += f" [{option}]" if option else ""
        yield fill(text, _width(), initial_indent=f"{STATES[state]:<9}", subsequent_indent=" " * 9)


def _width() -> int:
    return min(WIDTH, shutil.get_terminal_size((WIDTH, 24)).columns)
