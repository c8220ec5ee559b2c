"""What a terminal is told while a job works."""

import io
import sys
import threading

import pytest

from frictionzoo.core.telling import tell, telling_again


class Terminal(io.StringIO):
    """Keeps what it is told, and how many lines it awaits."""

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


@pytest.mark.parametrize("doing", ["compiling", ""])
def test_what_takes_long_is_told_again_until_it_ends(monkeypatch: pytest.MonkeyPatch, doing: str) -> None:
    tell("")  # another test may have told something
    terminal = Terminal(lines=3 if doing else 1)
    monkeypatch.setattr(sys, "stderr", terminal)
    with telling_again(every=0.02):
        tell(doing)
        assert terminal.enough.wait(10 if doing else 0.1) == bool(doing)
    told = terminal.getvalue().splitlines()
    assert not doing or (told[0] == "compiling ..." and {*told[1:]} == {"compiling, 0 s so far ..."})
    assert not any(thread.name == "telling again" for thread in threading.enumerate())
