"""What a user is told: what a command does at the moment, and shares in per cent."""

import sys


def tell(doing: str) -> None:
    """Say on the standard error what is being done now, at once; nothing where that is no terminal."""
    if sys.stderr.isatty():
        print(f"{doing} ...", file=sys.stderr, flush=True)


def say_percent(share: float, digits: int = 2) -> str:
    """A share with so many significant digits or more, never as a power of ten: 0.0712 is `7.1 %`, 23.71 `2371 %`."""
    percent, rounded = 100 * share, f"{100 * share:.{digits}g}"
    return f"{percent:.0f} %" if "e+" in rounded else f"{rounded} %"


def show_controls(text: str) -> str:
    """Show control characters of a name as escapes, line breaks among them."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
