"""Formatting of numbers, units and names for figures and pages."""

import inspect
import re
import textwrap
from collections.abc import Callable, Sequence

from frictionzoo.core.telling import escape_controls, say_percent
from frictionzoo.result.comparison.types import Comparison, Seeds


def format_number(value: float | Sequence[float] | None) -> str:
    """Format a value, or one value per joint."""
    if value is None:
        return "none"
    return f"{value:.4g}" if isinstance(value, int | float) else ", ".join(f"{joint:.4g}" for joint in value)


def say_origin(origin: str | None) -> str:
    """Return a phrase for the origin of data, from `data.origin` of a result."""
    return "your recordings" if origin is None else f"{origin} data"


def format_unit(unit: str) -> str:
    """Format a unit; empty for a dimensionless number."""
    return "" if unit == "1" else unit.replace("^2", "²")


def format_change(value: float | None, reference: float | None, signs: str = "−±+") -> str:
    """Format the relative change, with `signs` for less, the same and more; empty if there is nothing to compare."""
    if value is None or not reference:
        return ""
    percent = round(100 * (value / reference - 1))
    return f"{signs[1 + (percent > 0) - (percent < 0)]}{abs(percent)} %"


def format_share(value: float | None, whole: float | None) -> str:
    """Format a value as a share of a whole; empty if there is nothing to compare."""
    return "" if value is None or not whole else say_percent(value / whole, digits=3)


def count_runs(comparison: Comparison) -> int:
    """Return the number of runs; those with the same results for all seeds count as one."""
    seeds = [run.seeds for run in comparison.runs]
    return sum(1 if each is None or each.deterministic else len(each.values) for each in seeds)


def say_seeds(seeds: Seeds | None, sign: str = "±", write: Callable[[float], str] = "{:.2g}".format) -> str:
    """Return the number of seeds with the standard deviation of the test error over them; empty for one seed."""
    if seeds is None or seeds.deterministic:
        return "deterministic" if seeds else ""
    return f"{len(seeds.values)} seeds" + ("" if seeds.test_std is None else f" {sign} {write(seeds.test_std)}")


def format_digits(value: float, digits: int) -> str:
    """Format a value with this number of significant digits, including trailing zeros."""
    return f"{value:#.{digits}g}".rstrip(".")


def wrap(text: str, width: int, lines: int | None = None) -> list[str]:
    """Wrap a user's text to lines of this width, and at most this number of lines."""
    return textwrap.wrap(text, width, max_lines=lines, placeholder=" …") or [" "]


def escape_markdown(text: str) -> str:
    """Escape a user's text so that Markdown shows it unchanged, also in tables."""
    return re.sub(r"([\\`*_{}\[\]<>#|!~&])", r"\\\1", escape_controls(text))


def to_markdown(docstring: str, typeset: Callable[[str], str] | None = None) -> str:
    """Convert a docstring up to its first section to Markdown; equations and symbols become code blocks.

    An equation is a paragraph before the indented list of symbols; `typeset` converts it to Markdown instead.
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
