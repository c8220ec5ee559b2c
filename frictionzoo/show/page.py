"""What the pages for a browser share: templates, and how they print numbers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from frictionzoo.result.types import ParameterRow
from frictionzoo.show import with_plotly
from frictionzoo.show.colors import DARK
from frictionzoo.show.figure import Figure
from frictionzoo.show.text import format_change, format_number, format_unit


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
    **content: Any,
) -> bytes:
    """One self-contained page.

    Args:
        template: Its file, relative to the package; it extends `show/page.html.jinja`.
        sections: Figures by the name that the template has for them.
        checks: Why to trust it, and why not.
        points: At most so many of each curve.
        content: What else the template names: the program's `version`; `state` is handed to the page's script.
    """
    drawn = {name: [with_plotly.draw(figure, points) for figure in figures] for name, figures in sections.items()}
    names = list(sections)
    return (
        _environment()
        .get_template(template)
        .render(
            sections=sections,
            # Number of the first figure of each section.
            first={name: sum(len(drawn[before]) for before in names[:i]) for i, name in enumerate(names)},
            figures=[figure for figures in drawn.values() for figure in figures],
            checks=checks,
            doubts=sum(check.doubtful for check in checks),
            dark=DARK,
            plotly=get_plotlyjs().replace("</script", "<\\/script"),
            **{"state": {}} | content,
        )
        .encode()
    )


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("frictionzoo", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": format_number, "unit": format_unit, "place": _place, "change": format_change}
    return environment


def _place(value: float, parameter: ParameterRow, joint: int) -> float:
    """Where a joint's value lies between its bounds, from 0 to 100; in decades where the bounds are positive."""
    low, high = (end[joint] if isinstance(end, list) else end for end in (parameter["low"], parameter["high"]))
    if low > 0:
        low, high, value = math.log(low), math.log(high), math.log(max(value, low))
    return round(100 * min(1.0, max(0.0, (value - low) / (high - low))), 1)
