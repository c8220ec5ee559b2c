"""Rendering of HTML pages: templates, packed libraries, and filters that print numbers."""

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from frictionzoo.core.output import write_atomically
from frictionzoo.core.telling import say_percent
from frictionzoo.core.templates import open_template
from frictionzoo.diagnostics.findings import Finding
from frictionzoo.report import with_plotly
from frictionzoo.report.colors import DARK
from frictionzoo.report.figure import Figure
from frictionzoo.report.text import format_change, format_number, format_share, format_unit, say_origin
from frictionzoo.result.names import label_values, list_widths, merge_known, place_between_bounds, read_values
from frictionzoo.result.types import ParameterRecord, Value


def save_page(
    path: Path,
    template: str,
    sections: Mapping[str, Sequence[Figure]],
    checks: Sequence[Finding],
    points: int = with_plotly.POINTS,
    state: Mapping[str, Any] | None = None,
    **content: Any,
) -> None:
    """Write one self-contained page from a template, relative to the package, that extends `report/page.html.jinja`.

    `sections` has figures by the template's name for them, with at most `points` points per curve. `state` is data for
    the page's script, `content` for the template, such as the program's `version`.

    Raises:
        OutputError: The file cannot be written.
    """
    first, figures = dict[str, int](), list[dict[str, Any]]()
    for name, described in sections.items():
        first[name] = len(figures)  # index of the first figure of each section
        figures += [with_plotly.draw(figure, points) for figure in described]
    data = {"figures": figures, "dark": DARK, "state": state or {}}
    page = open_template(template, _FILTERS, html=True).render(
        sections=sections,
        first=first,
        data=pack(json.dumps(data, separators=(",", ":"))),
        plotly=pack_library("plotly/plotly-basic.min.js"),
        checks=checks,
        doubts=sum(check.doubtful for check in checks),
        state=state or {},
        **content,
    )
    write_atomically(path, page.encode())


def pack(text: str) -> str:
    """Compress a text for the page's script to less than half its size: base64 of gzip, without a date."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


@cache
def pack_library(path: str) -> str:
    """Return a packed JavaScript library that pages embed, by its path relative to this folder."""
    return pack(resources.files("frictionzoo.report").joinpath(*path.split("/")).read_text(encoding="utf-8"))


def _overview(parameter: ParameterRecord) -> dict[str, Any]:
    """Summarise a parameter of several joints in one line: mean or range, and doubtful values."""
    rows, first_row = [row for row in parameter.by_joint if row.identified], parameter.by_joint[0]
    values = read_values(parameter)
    values = values[~np.isnan(values)]
    ended = sum(row.at_bound for row in rows)
    vague = sum(row.identifiable is False and not row.at_bound for row in rows)
    counts = (ended, "at a bound"), (vague, "not identifiable")
    low, high = format_number(float(values.min())), format_number(float(values.max()))
    spread = low if low == high else f"{low} to {high}"
    shared = f"shared by {first_row.name}" if len(first_row.joints) > 1 else first_row.name
    return {
        "value": format_number(float(values.mean())) if rows else spread,
        "said": (shared if len(parameter.by_joint) == 1 else spread) if rows else "known",
        "doubt": ", ".join(label if len(rows) == 1 else f"{n} of {len(rows)} {label}" for n, label in counts if n),
    }


def _place(row: Value, value: float) -> float:
    return round(100 * place_between_bounds(row, np.array([float(value)])).item(), 1)


def _say_certainty(parameters: Sequence[ParameterRecord]) -> str:
    """Return a sentence with the identifiable values of the widest and narrowest relative interval; empty for none."""
    rows = {label: row for p in parameters for label, row in label_values(p).items() if row.identified}
    sure = {label for label, row in rows.items() if row.identifiable is not False}
    width = {label: share for label, share in list_widths(parameters).items() if label in sure}
    if not width:
        return ""
    least, most = max(width, key=width.__getitem__), min(width, key=width.__getitem__)
    scope = " of the identifiable values" if len(sure) < len(rows) else ""
    text = f"Least certain{scope}: {least}, ± {say_percent(width[least])}"
    return f"{text}; most certain: {most}, ± {say_percent(width[most])}." if most != least else f"{text}."


_FILTERS = {
    "number": format_number,
    "unit": format_unit,
    "place": _place,
    "change": format_change,
    "merge_known": merge_known,
    "overview": _overview,
    "share": format_share,
    "percent": say_percent,
    "certainty": _say_certainty,
    "say_origin": say_origin,
}
