"""Text for a person: printed, logged or raised, with control characters escaped, and shares in per cent."""

import argparse
import contextlib
import logging
import re
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

# Control characters, marks that change the direction of text, other separators of lines, and halves of surrogate pairs.
_CONTROL = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff\U000e0000-\U000e007f]"
)


def escape_controls(text: str, keep: str = "") -> str:
    """Return the text with its control characters in hexadecimal, as Python writes them, but for those in `keep`.

    A terminal would obey them: names in a recording or a run of somebody else could hide or forge what it shows.
    """
    return _CONTROL.sub(lambda found: found[0] if found[0] in keep else ascii(found[0])[1:-1], text)


def escape_all(value: Any) -> Any:
    """Return the same mappings and lists with every text in them escaped, line breaks too."""
    if isinstance(value, str):
        return escape_controls(value)
    if isinstance(value, Mapping):
        return {escape_all(key): escape_all(part) for key, part in value.items()}
    return type(value)(map(escape_all, value)) if type(value) in (list, tuple) else value


def say(text: str) -> None:
    """Print lines on the standard output."""
    print(escape_controls(text, keep="\n"))


_told = "", 0.0
"""What was told last, and when, by `time.monotonic`."""


def tell(doing: str) -> None:
    """Say on the standard error what is being done now, at once; nothing where that is no terminal."""
    global _told
    _told = doing, time.monotonic()
    if doing and sys.stderr.isatty():
        print(f"{escape_controls(doing)} ...", file=sys.stderr, flush=True)


@contextlib.contextmanager
def telling_again(every: float = 10.0) -> Iterator[None]:
    """Say again what is being done, and for how long, whenever nothing was told for a time.

    Args:
        every: That time [s].
    """
    ended = threading.Event()

    def watch() -> None:
        told, again = _told, every
        while not ended.wait(every / 10):
            if _told != told:
                told, again = _told, every
            doing, since = told
            passed = time.monotonic() - since
            if doing and passed >= again and sys.stderr.isatty():
                print(f"{escape_controls(doing)}, {passed:.0f} s so far ...", file=sys.stderr, flush=True)
                again += every

    watching = threading.Thread(target=watch, name="telling again", daemon=True)
    watching.start()
    try:
        yield
    finally:
        ended.set()
        watching.join()
        tell("")


class LogFormatter(logging.Formatter):
    """A line for each record, which a traceback may follow."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        """Format a record without its traceback."""
        return escape_controls(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - logging's name
        """Format a traceback."""
        return escape_controls(super().formatException(ei), keep="\n")


class Parser(argparse.ArgumentParser):
    """A parser of arguments whose messages have no control characters."""

    def _print_message(self, message: str, file: Any = None) -> None:
        super()._print_message(escape_controls(message, keep="\n"), file)


def say_percent(share: float, digits: int = 2) -> str:
    """A share with so many significant digits or more, never as a power of ten: 0.0712 is `7.1 %`, 23.71 `2371 %`."""
    percent, rounded = 100 * share, f"{100 * share:.{digits}g}"
    return f"{percent:.0f} %" if "e+" in rounded else f"{rounded} %"
