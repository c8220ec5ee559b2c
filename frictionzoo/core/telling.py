"""Text for people: printed, logged or raised with control characters escaped; percentages, and aligned tables."""

import argparse
import contextlib
import logging
import os
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from frictionzoo.core.records import map_texts

Rows = Sequence[Sequence[str]]
Progress = str | Callable[[], Any]
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
    """Print lines on standard output; the current activity has ended."""
    tell("")
    print(escape_controls(text, keep="\n"))


class _Activity:
    """Current activity, and the line of the terminal that shows it.

    Attributes:
        since: When it began, by `time.monotonic`.
        job: Job of a sweep to which it belongs; None hides all activities.
        is_ticking: Whether the line stays unfinished, because `telling_again` renews it.
        length: Length of the unfinished line.
    """

    doing: str = ""
    progress: Progress = ""
    since: float = 0.0
    job: str | None = ""
    is_ticking: bool = False
    length: int = 0

    def show(self) -> None:
        """Print it with its progress and duration, in the same line as before."""
        progress = self.progress() if callable(self.progress) else self.progress
        if not (self.doing and is_watched()):
            return
        seconds = time.monotonic() - self.since
        end = f", {seconds:.0f} s" if seconds >= 1 else " ..."
        text = escape_controls(": ".join(filter(None, (self.job, self.doing, progress))))
        if not self.is_ticking:
            print(text + end, file=sys.stderr, flush=True)
            return
        text = text[: shutil.get_terminal_size().columns - 1 - len(end)] + end
        with _line:
            _write(f"\r{text.ljust(self.length)}" if self.length else text)
            self.length = len(text)


_now = _Activity()
_line = threading.RLock()
"""Held while the line changes. Its holder does not use a stream's buffer: whoever writes to one waits for this lock."""


def is_watched() -> bool:
    """Return whether standard error is a terminal that may show progress."""
    return _now.job is not None and sys.stderr.isatty()


def tell(doing: str, progress: Progress = "") -> None:
    """Show the current activity on standard error at once, if that is a terminal; an empty text ends it.

    `progress` is a text, or a function that returns one and is called once a second.
    """
    end_line()
    _now.doing, _now.progress, _now.since = doing, progress, time.monotonic()
    _now.show()


def tell_progress(progress: Progress) -> None:
    """Set the progress of the current activity, which the terminal shows within a second."""
    _now.progress = progress


def name_job(job: str | None) -> None:
    """Show activities as parts of this job of a sweep; None: show none in this process."""
    _now.job = job


def end_line() -> None:
    """Finish the line that shows the current activity; other output begins in a new one."""
    with _line:
        if _now.length:
            _now.length = 0
            _write("\n")


@contextlib.contextmanager
def in_new_line() -> Iterator[None]:
    """Finish the line that shows the current activity, and keep it from being renewed meanwhile."""
    with _line:
        end_line()
        yield


def _write(text: str) -> None:
    with contextlib.suppress(OSError):  # the terminal was closed
        os.write(sys.stderr.fileno(), text.encode(sys.stderr.encoding, "replace"))


@contextlib.contextmanager
def telling_again(every: float = 1.0) -> Iterator[None]:
    """Show progress and duration of the current activity every `every` seconds, if standard error is a terminal."""
    if not is_watched():
        yield
        return
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(every):
            _now.show()

    watching = threading.Thread(target=watch, name="telling again", daemon=True)
    _now.is_ticking = True
    watching.start()
    try:
        yield
    finally:
        ended.set()
        watching.join()
        tell("")
        _now.is_ticking = False


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
