"""What a terminal is told while a job works."""

import io
import sys
import threading

import pytest

from frictionzoo.core.telling import tell, telling_again


class Terminal(io.StringIO):
    """Keeps what it is told, and tells when it has been told enough."""

    def __init__(self, lines: int) -> None:
        super().__init__()
        self.lines, self.enough = lines, threading.Event()

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        written = super().write(text)
        if self.getvalue().count("\n") >= self.lines:
            self.enough.set()
        return written


def test_what_takes_long_is_told_again_until_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    tell("")  # another test may have told something
    terminal = Terminal(lines=3)
    monkeypatch.setattr(sys, "stderr", terminal)
    with telling_again(every=0.02):
        tell("compiling")
        assert terminal.enough.wait(10)
    told = terminal.getvalue().splitlines()
    assert told[0] == "compiling ..." and {*told[1:]} == {"compiling, 0 s so far ..."}
    assert not any(thread.name == "telling again" for thread in threading.enumerate())


def test_nothing_is_told_again_where_nothing_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal(lines=1)
    monkeypatch.setattr(sys, "stderr", terminal)
    tell("")
    with telling_again(every=0.01):
        assert not terminal.enough.wait(0.1)
