"""How figures and pages print numbers, units and names."""

import inspect
import re
import textwrap
from collections.abc import Callable, Sequence

from frictionzoo.core.telling import escape_controls, say_percent


def format_number(value: float | Sequence[float] | None, between: str = ", ") -> str:
    """A value, or one for each joint, as it is printed."""
    if value is None:
        return "none"
    return f"{value:.4g}" if isinstance(value, int | float) else between.join(f"{joint:.4g}" for joint in value)


def say_origin(origin: str | None) -> str:
    """Return where data come from, as `data.origin` of a result states it."""
    return "your recordings" if origin is None else f"{origin} data"


def format_unit(unit: str) -> str:
    """A unit as it is printed; nothing for a pure number."""
    return "" if unit == "1" else unit.replace("^2", "²")


def format_change(value: float | None, reference: float | None) -> str:
    """Relative change, where there is something to compare."""
    if value is None or not reference:
        return ""
    percent = round(100 * (value / reference - 1))
    return f"{'−' if percent < 0 else '+' if percent > 0 else '±'}{abs(percent)} %"


def format_share(value: float | None, whole: float | None) -> str:
    """What part of a whole a value is, where there is something to compare."""
    return "" if value is None or not whole else say_percent(value / whole, digits=3)


def format_digits(value: float, digits: int) -> str:
    """A value with so many significant digits, also where the last ones are 0."""
    return f"{value:#.{digits}g}".rstrip(".")


def wrap(text: str, width: int, lines: int | None = None) -> list[str]:
    """A user's text on lines of this width, at most so many of them."""
    return textwrap.wrap(text, width, max_lines=lines, placeholder=" …") or [" "]


def escape_markdown(text: str) -> str:
    """Write a user's text as Markdown that shows it unchanged, in a table too."""
    return re.sub(r"([\\`*_{}\[\]<>#|!~&])", r"\\\1", escape_controls(text))


def to_markdown(docstring: str, typeset: Callable[[str], str] | None = None) -> str:
    """A docstring's paragraphs up to its arguments; equations and symbols become blocks of code.

    Args:
        docstring: With an equation, if it has any, as a paragraph before the indented list of symbols.
        typeset: Makes Markdown of equations; blocks of code without it.
    """
    text = re.split(r"\n\n(?:Args|Raises|Attributes):\n", inspect.cleandoc(docstring))[0]
    blocks = text.split("\n\n")
    symbols = next((i for i, block in enumerate(blocks) if block.startswith(" ")), len(blocks))
    for i, block in enumerate(blocks):
        lines = block.split("\n")
        equation = 0 < i < symbols and all(re.search(r" <?= ", line) or line.startswith(" ") for line in lines)
        if equation and typeset:
            blocks[i] = typeset(block)
        elif equation or block.startswith(" "):
            blocks[i] = f"```\n{textwrap.dedent(block)}\n```"
    return "\n\n".join(blocks)
