"""End of a command: a mistake or a signal gives one line on standard error and an exit status."""

import atexit
import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn

from frictionzoo.core.errors import OutputError
from frictionzoo.core.telling import escape_controls, in_new_line, tell

REFUSED = 2
"""Exit status for a mistake that the user has to correct."""
NOT_IDENTIFIED = 3
"""Exit status of a fit that finished without identifying the drive; of a sweep, if its recommended run has it."""
CHANGED = 4
"""Exit status of a comparison that found a drive changed."""
NOTHING_KEPT = "nothing is kept; run it again"
"""Advice after a command that ended before it saved anything."""


class Stopped(BaseException):
    """Ctrl-C or SIGTERM. It is no `Exception`, which a library might catch as a failure and continue."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextlib.contextmanager
def mistakes_in_one_line(
    go_on: Callable[[], str] = lambda: NOTHING_KEPT, overrides: Sequence[str] = ()
) -> Iterator[None]:
    """Turn a user's mistake into one line and exit status 2, and a signal into one line and 128 + its number.

    After a signal or a write error, `go_on` returns the saved state and how to resume. Hydra's `overrides` help to
    explain its refusals.
    """
    with stoppable():
        try:
            yield
        except Stopped as stop:
            fail(f"stopped by {signal.Signals(stop.number).name}; {go_on()}", status=128 + stop.number)
        except Exception as error:
            # Imported late: --help does not wait for Hydra.
            from frictionzoo.cli.explain import explain

            line = explain(error, overrides)
            if line is None:
                raise
            ended = isinstance(error, OutputError) or (isinstance(error, OSError) and error.strerror)
            fail(f"{line}; {go_on()}" if ended else line)


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Let the first Ctrl-C or SIGTERM raise `Stopped`; further ones do not disturb the cleanup.

    Signals that are already handled or ignored stay so.
    """

    def stop(number: int, frame: Any) -> None:
        if not stopped:
            stopped.append(number)
            raise Stopped(number)

    def try_again(lost: Any) -> None:
        # Python drops exceptions from callbacks of its garbage collector, and JAX has such a callback.
        if not isinstance(lost.exc_value, Stopped):
            return hook(lost)
        stopped.clear()
        threading.Timer(0.05, os.kill, [os.getpid(), lost.exc_value.number]).start()

    stopped: list[int] = []
    handlers, hook = {}, sys.unraisablehook
    for number in (signal.SIGINT, signal.SIGTERM):
        is_handled = signal.getsignal(number) not in (signal.SIG_DFL, signal.default_int_handler)
        if not is_handled and threading.current_thread() is threading.main_thread():
            handlers[number] = signal.signal(number, stop)
    if handlers:
        sys.unraisablehook = try_again
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in handlers.items():
            signal.signal(number, handler)


class _Lasting(io.FileIO):
    """A standard stream that becomes the null device when its reader is gone or the disk is full.

    `fault` is the reason of a failure; empty if the reader is gone.
    """

    fault = ""

    def write(self, data: Any) -> int | None:
        try:
            with in_new_line():
                return super().write(data)
        except OSError as error:
            self.fault = "" if isinstance(error, BrokenPipeError) else str(error.strerror)
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.fileno())
            os.close(null)
            return memoryview(data).nbytes


def outlive_readers() -> None:
    """Let a command continue and write its files when nobody reads its output.

    A standard stream that is closed from the start becomes the null device: otherwise the next file takes its number.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - until the process ends
        elif type(stream) is io.TextIOWrapper and not _lasting(stream):
            buffer = _Lasting(stream.fileno(), "w", closefd=False)
            lines, through = stream.line_buffering, stream.write_through
            buffer = buffer if through else io.BufferedWriter(buffer)
            setattr(sys, name, io.TextIOWrapper(buffer, stream.encoding, stream.errors, None, lines, through))


def _lasting(stream: Any) -> _Lasting | None:
    """Return the raw stream that `outlive_readers` put behind a stream, if any."""
    buffer = getattr(stream, "buffer", None)
    raw = getattr(buffer, "raw", buffer)
    return raw if isinstance(raw, _Lasting) else None


def hand_over_output() -> None:
    """Flush standard output; end with one line and status 2 if that failed, as on a full disk."""
    sys.stdout.flush()
    if (output := _lasting(sys.stdout)) and output.fault:
        fail(f"standard output: {output.fault}; not all of it was printed")


def exit_beside_threads(status: int) -> NoReturn:
    """End the process after a signal: XLA's threads may still compile, and crash while C++ removes what they use."""
    atexit._run_exitfuncs()  # Ray ends its processes here, and logging flushes
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def fail(*lines: str, status: int = REFUSED) -> NoReturn:
    """End the program with these lines on standard error and this exit status."""
    tell("")
    for line in lines:
        print(f"frictionzoo: {escape_controls(line)}", file=sys.stderr)
    sys.exit(status)
