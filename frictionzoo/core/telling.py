"""Text for people: printed, logged or raised with control characters escaped; percentages, and aligned tables."""

import argparse
import contextlib
import logging
import re
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from frictionzoo.core.records import map_texts

Rows = Sequence[Sequence[str]]
_COLUMNS = {"qpos": "position", "qvel": "velocity", "ctrl": "command", "torque": "torque"}
# Control characters, text direction marks, line separators, halves of surrogate pairs.
_CONTROL = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff\U000e0000-\U000e007f]"
)


def escape_controls(text: str, keep: str = "") -> str:
    """Return the text with control characters in hexadecimal, as Python writes them, except those in `keep`.

    A terminal would obey them: names in someone else's recording or run could hide or forge its output.
    """
    return _CONTROL.sub(lambda found: found[0] if found[0] in keep else ascii(found[0])[1:-1], text)


def escape_all(value: Any) -> Any:
    """Return the same records, mappings and lists with every text escaped, including line breaks."""
    return map_texts(value, escape_controls)


def say(text: str) -> None:
    """Print lines on standard output."""
    print(escape_controls(text, keep="\n"))


_told = "", 0.0
"""Last progress message and its time, by `time.monotonic`."""


def tell(doing: str) -> None:
    """Print the current activity on standard error at once, if that is a terminal."""
    global _told
    _told = doing, time.monotonic()
    if doing and sys.stderr.isatty():
        print(f"{escape_controls(doing)} ...", file=sys.stderr, flush=True)


@contextlib.contextmanager
def telling_again(every: float = 10.0) -> Iterator[None]:
    """Repeat the current activity and its duration whenever nothing was printed for `every` seconds."""
    ended = threading.Event()

    def watch() -> None:
        activity, due = _told, every
        while not ended.wait(every / 10):
            if _told != activity:
                activity, due = _told, every
            doing, since = activity
            passed = time.monotonic() - since
            if doing and passed >= due and sys.stderr.isatty():
                print(f"{escape_controls(doing)}, {passed:.0f} s so far ...", file=sys.stderr, flush=True)
                due += every

    watching = threading.Thread(target=watch, name="telling again", daemon=True)
    watching.start()
    try:
        yield
    finally:
        ended.set()
        watching.join()
        tell("")


class LogFormatter(logging.Formatter):
    """Formatter of one line a record, perhaps followed by a traceback."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        """Format a record without its traceback."""
        return escape_controls(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - logging's name
        """Format a traceback."""
        return escape_controls(super().formatException(ei), keep="\n")


class Parser(argparse.ArgumentParser):
    """Argument parser whose messages have no control characters."""

    def _print_message(self, message: str, file: Any = None) -> None:
        super()._print_message(escape_controls(message, keep="\n"), file)


def say_percent(share: float, digits: int = 2) -> str:
    """Format a share in per cent with at least `digits` digits, without exponent: 0.0712 is `7.1 %`, 23.71 `2371 %`."""
    percent, rounded = 100 * share, f"{100 * share:.{digits}g}"
    return f"{percent:.0f} %" if "e+" in rounded else f"{rounded} %"


def align(rows: Rows) -> str:
    """Align a table: columns padded to their longest entry, numbers right-aligned, text left-aligned."""
    columns = list(zip(*rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    is_number = re.compile("none|[+.0-9-].*|", re.DOTALL).fullmatch
    flush = [str.rjust if all(map(is_number, column[1:])) else str.ljust for column in columns]
    lines = ("  ".join(pad(cell, width) for pad, cell, width in zip(flush, row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


def list_columns(columns: Mapping[str, Any]) -> Rows:
    """Return a table of the column assigned to each joint, from `columns` of `result.json` or `inspect.json`."""
    signals = sorted(columns["by"], key=[*_COLUMNS, *columns["by"]].index)
    rows = [(row["joint"], *(row["columns"].get(signal, "none") for signal in signals)) for row in columns["joints"]]
    return [("joint <-", *(str(_COLUMNS.get(signal, signal)) for signal in signals)), *rows]
