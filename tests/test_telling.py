"""Progress at a terminal while a command works."""

import contextlib
import os
import pty
import subprocess
import sys

from conftest import ROOT

PROGRAM = """
import os, sys, time
from frictionzoo.cli.mistakes import outlive_readers
from frictionzoo.core.telling import name_job, say, tell, tell_progress, telling_again

outlive_readers()
with telling_again(every=0.01):
    tell("compiling\x1b[2J")
    time.sleep(1.2)
    tell("fit")
    tell_progress("evaluation 2")
    time.sleep(0.1)
    say("result")
    time.sleep(0.1)
    name_job("job 2 of 3")
    tell("sweep", lambda: "1 done")
    print("log line", file=sys.stderr)
    time.sleep(0.1)
    name_job(None)
    tell("hidden")
tell("hidden")
name_job("")
tell("without repetition")
"""


def show(at_terminal: bool) -> list[str]:
    """Return the lines that the program leaves on a terminal, each with its earlier states; or on pipes."""
    command, environment = [sys.executable, "-c", PROGRAM], {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "80"}
    if not at_terminal:
        pipes = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return (pipes.stdout + pipes.stderr).splitlines()
    terminal, end = pty.openpty()
    process = subprocess.Popen(command, env=environment, stdout=end, stderr=end)
    os.close(end)
    written = b""
    with contextlib.suppress(OSError):  # how a terminal ends whose programs have
        while more := os.read(terminal, 1 << 16):
            written += more
    os.close(terminal)
    assert process.wait() == 0
    return written.decode().split("\r\n")


def test_a_terminal_shows_activity_progress_and_duration_in_one_line() -> None:
    lines = [line.split("\r") for line in show(at_terminal=True)]
    assert lines[0][0] == r"compiling\x1b[2J ..." and lines[0][-1].rstrip() == r"compiling\x1b[2J, 1 s"
    assert lines[1][0] == "fit ..." and lines[1][-1] == "fit: evaluation 2 ..."
    ends = [states[-1].rstrip() for states in lines[2:]]
    sweep = "job 2 of 3: sweep: 1 done ..."
    assert ends == ["result", sweep, "log line", sweep, "without repetition ...", ""]
    assert max(len(state) for states in lines for state in states) < 80


def test_a_pipe_has_no_progress() -> None:
    assert show(at_terminal=False) == ["result", "log line"]
