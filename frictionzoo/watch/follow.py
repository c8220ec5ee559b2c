"""Look again and again, and show what has changed."""

import shutil
import sys
import time

from frictionzoo.watch.jobs import Job, Watched
from frictionzoo.watch.terminal import draw, tell_changes

PAUSE = 1.0  # s from look to look
_ALL = (sys.maxsize, sys.maxsize)  # columns and rows of what is no terminal


def show(watched: Watched) -> None:
    """Print how all jobs stand, whatever room that takes."""
    print("\n".join(draw(watched.look(), *_ALL)))


def follow(watched: Watched) -> list[Job]:
    """Print how jobs stand until all have ended: in place on a terminal, else what has changed; how they ended."""
    in_place, jobs, shown = sys.stdout.isatty(), None, []
    while True:
        before, jobs = jobs, watched.look()
        over = watched.is_over(jobs)
        if in_place:
            # At the end, all of it stays there to be read.
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
