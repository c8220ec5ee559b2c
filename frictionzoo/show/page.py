"""What the pages for a browser share: templates, and how they print numbers."""

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from frictionzoo.core.telling import say_percent
from frictionzoo.core.templates import open_template
from frictionzoo.result.names import label_values, merge_known, place_between_bounds, read_values
from frictionzoo.result.types import ParameterRow, ValueRow
from frictionzoo.show import with_plotly
from frictionzoo.show.colors import DARK
from frictionzoo.show.figure import Figure
from frictionzoo.show.text import format_change, format_number, format_share, format_unit, say_origin


@dataclass(frozen=True)
class Check:
    """One reason to trust the result, or to doubt it.

    Attributes:
        state: `good`, `note`, `caution` or `bad`.
        title: What was looked at.
        text: What was seen, in plain sentences.
        option: What to add to the command line; None where nothing is to be added.
    """

    state: str
    title: str
    text: str
    option: str | None = None

    @property
    def doubtful(self) -> bool:
        """Whether it is a reason to doubt."""
        return self.state in ("caution", "bad")


def render_page(
    template: str,
    sections: Mapping[str, Sequence[Figure]],
    checks: Sequence[Check],
    points: int = with_plotly.POINTS,
    state: Mapping[str, Any] | None = None,
    **content: Any,
) -> bytes:
    """One self-contained page.

    Args:
        template: Its file, relative to the package; it extends `show/page.html.jinja`.
        sections: Figures by the name that the template has for them.
        checks: Why to trust it, and why not.
        points: At most so many of each curve.
        state: What the page's script is handed besides.
        content: What else the template names, as the program's `version`.
    """
    drawn = {name: [with_plotly.draw(figure, points) for figure in figures] for name, figures in sections.items()}
    names, figures = list(sections), [figure for figures in drawn.values() for figure in figures]
    data = {"figures": figures, "dark": DARK, "state": state or {}}
    return (
        open_template(template, _FILTERS, html=True)
        .render(
            sections=sections,
            # Number of the first figure of each section.
            first={name: sum(len(drawn[before]) for before in names[:i]) for i, name in enumerate(names)},
            data=pack(json.dumps(data, separators=(",", ":"))),
            plotly=pack_library("plotly/plotly-basic.min.js"),
            checks=checks,
            doubts=sum(check.doubtful for check in checks),
            state=state or {},
            **content,
        )
        .encode()
    )


def pack(text: str) -> str:
    """A text for a page's script to unpack, of less than half its size: base64 of gzip, without a date."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


@cache
def pack_library(path: str) -> str:
    """A library that pages carry, by its path beside this file, packed."""
    return pack(resources.files("frictionzoo.show").joinpath(*path.split("/")).read_text(encoding="utf-8"))


def _overview(parameter: ParameterRow) -> dict[str, Any]:
    """A parameter of several joints in one line: the mean or the range, and what is doubtful."""
    rows, first = [row for row in parameter["by_joint"] if row["identified"]], parameter["by_joint"][0]
    values = read_values(parameter)
    values = values[~np.isnan(values)]
    ended = sum(row["at_bound"] for row in rows)
    vague = sum(row["identifiable"] is False and not row["at_bound"] for row in rows)
    counts = (ended, "at a bound"), (vague, "not identifiable")
    low, high = format_number(float(values.min())), format_number(float(values.max()))
    spread = low if low == high else f"{low} to {high}"
    return {
        "value": format_number(float(values.mean())) if rows else spread,
        "said": (_say_whose(first) if len(parameter["by_joint"]) == 1 else spread) if rows else "known",
        "doubt": ", ".join(what if len(rows) == 1 else f"{n} of {len(rows)} {what}" for n, what in counts if n),
    }


def _say_whose(row: ValueRow) -> str:
    return f"shared by {row['name']}" if len(row["joints"]) > 1 else row["name"]


def _place(row: ValueRow, value: float) -> float:
    """Where a value lies between the bounds of a row, from 0 to 100, as `place_between_bounds` has it."""
    return round(100 * place_between_bounds(row, np.array([float(value)])).item(), 1)


def _say_certainty(parameters: Sequence[ParameterRow]) -> str:
    """Which identifiable values have the widest and the narrowest interval for their size; empty where none has one."""
    rows = {label: row for p in parameters for label, row in label_values(p).items() if row["identified"]}
    width = {
        label: (row["interval"][1] - row["interval"][0]) / abs(2 * row["value"])
        for label, row in rows.items()
        if row["interval"] is not None and row["value"] and row["identifiable"] is not False
    }
    if not width:
        return ""
    least, most = max(width, key=width.__getitem__), min(width, key=width.__getitem__)
    whose = " of what is identifiable" if any(row["identifiable"] is False for row in rows.values()) else ""
    said = f"Least certain{whose}: {least}, ± {say_percent(width[least])}"
    return f"{said}; most: {most}, ± {say_percent(width[most])}." if most != least else f"{said}."


_FILTERS = {
    **{"number": format_number, "unit": format_unit, "place": _place, "change": format_change},
    **{
        "merge_known": merge_known,
        "overview": _overview,
        "share": format_share,
        "percent": say_percent,
        "certainty": _say_certainty,
        "say_origin": say_origin,
    },
}
