"""Display of the progress of jobs, once or until they end."""

import shutil
import sys
import time

from frictionzoo.watch.jobs import Job, Watched
from frictionzoo.watch.terminal import draw, tell_changes

PAUSE = 1.0  # time between two reads [s]
_ALL = (sys.maxsize, sys.maxsize)  # columns and rows without a limit


def show(watched: Watched) -> None:
    """Print the state of all jobs, without a limit on size."""
    print("\n".join(draw(watched.look(), *_ALL)))


def follow(watched: Watched) -> list[Job]:
    """Print the state of jobs until all have ended, and return the final states.

    A terminal is refreshed in place; otherwise only changes are printed.
    """
    in_place, jobs, shown = sys.stdout.isatty(), None, []
    while True:
        before, jobs = jobs, watched.look()
        over = watched.is_over(jobs)
        if in_place:
            # The final output is complete and stays on the terminal.
            lines = draw(jobs, *(_ALL if over else shutil.get_terminal_size()))
            up = f"\x1b[{len(shown)}A\r\x1b[J" if shown else ""
            if lines != shown:
                print(up + "\n".join(lines), flush=True)
            shown = lines
        else:
            for line in tell_changes(before, jobs):
                print(line, flush=True)
        if over:
            return jobs
        time.sleep(PAUSE)
