"""Start-up time of commands: from the prompt to the first output, and to the end.

    python benchmarks/start.py
    python benchmarks/start.py --repeats 5

Each command runs in a separate process on a pseudo-terminal, as a user starts it. Warm: median of repeated runs after
the cold one. Cold: the environment's files are not in the system's memory, and caches of earlier runs are empty.
"""

import argparse
import contextlib
import math
import os
import pty
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from measure import make_parser, report

COMMANDS = {  # user action: command, exit status
    "help": ("--help", 0),
    "options": ("--cfg job", 0),
    "laws": ("list models", 0),
    "unknown option": ("model=lugre fit.iteration=3", 2),
    "value of another kind": ("model=lugre segments.length=abc", 2),
    "YAML that does not end": ("'data.train=[a.csv'", 2),
    "unknown law": ("model=coulomb_stribek", 2),
    "unknown group": ("modle=lugre", 2),
    "no such recording": ("data=files data.train=[none.csv]", 2),
    "no such column": ("data=files data.train=[a.csv] data.columns.qpos=angle", 2),
    "text in a recording": ("data=files data.train=[text.csv]", 2),
    "no such joint": ("data=files bench=knee data.train=[a.csv] bench.joint=elbow", 2),
    "impossible bounds": ("data=files bench=knee data.train=[a.csv] model.params.static_torque.high=-3", 2),
    "no such run": ("export none target=mjcf", 2),
    "inspect": ("inspect a.csv", 0),
    "short run": (
        "model=mujoco_default fit=lm recipe=given data=files bench=knee data.train=[a.csv] hydra.run.dir=run",
        0,
    ),
}
PROGRAM = "from frictionzoo.cli.commands import main; main()"  # the console script, of the package on the path
COLUMNS = {
    "what": "what the user does",
    "first": "first sign of life [s]",
    "seconds": "end [s]",
    "cold_first": "cold: first sign [s]",
    "cold_seconds": "cold: end [s]",
    "status": "exit status",
}
SAMPLES, STEP = 16000, 0.001  # of the recording: number, interval [s]


class Seen(NamedTuple):
    """Timing of a command as its user sees it.

    Attributes:
        first: Time from the start to the first character on the terminal [s].
        seconds: Time from the start to the end [s].
        status: Exit status.
    """

    first: float
    seconds: float
    status: int


def main() -> None:
    """Measure all commands and print a table."""
    options = parse()
    with tempfile.TemporaryDirectory() as folder:
        write_recordings(Path(folder))
        rows = [measure(name, Path(folder), options) for name in options.commands or COMMANDS]
    report(options.out, rows, COLUMNS, repeats=options.repeats)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("start", __doc__)
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="warm starts that count; 3 by default")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, metavar="NAME", help="some of the rows")
    return parser.parse_args()


def measure(name: str, folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Run a command once cold and then repeatedly warm; return its row."""
    words, expected = COMMANDS[name]
    with tempfile.TemporaryDirectory() as empty:
        # Caches of this package, of fonts and of compiled functions.
        caches = {name: empty for name in ("XDG_CACHE_HOME", "MPLCONFIGDIR", "JAX_COMPILATION_CACHE_DIR")}
        forget_files()
        cold = watch(words, folder, caches)
        warm = [watch(words, folder, caches) for _ in range(options.repeats)]
    if {each.status for each in (cold, *warm)} != {expected}:
        raise SystemExit(f"frictionzoo {words}: exit status {cold.status}, expected {expected}")
    return {
        "what": name,
        "command": words,
        "first": statistics.median(each.first for each in warm),
        "seconds": statistics.median(each.seconds for each in warm),
        "cold_first": cold.first,
        "cold_seconds": cold.seconds,
        "status": expected,
    }


def watch(words: str, folder: Path, variables: dict[str, str]) -> Seen:
    """Run a command on a new pseudo-terminal."""
    terminal, end = pty.openpty()
    command = [sys.executable, "-c", PROGRAM, *shlex.split(words)]
    began, first = time.perf_counter(), math.nan
    process = subprocess.Popen(
        command, cwd=folder, env={**os.environ, **variables}, stdin=subprocess.DEVNULL, stdout=end, stderr=end
    )
    os.close(end)
    with contextlib.suppress(OSError):  # a terminal raises this when its programs have ended
        while os.read(terminal, 1 << 16):
            first = time.perf_counter() - began if math.isnan(first) else first
    status = process.wait()
    os.close(terminal)
    return Seen(first, time.perf_counter() - began, status)


def forget_files() -> None:
    """Ask the system, if it supports it, to drop this environment's files from its file cache."""
    if not hasattr(os, "posix_fadvise"):
        return
    homes = {Path(path) for path in sys.path if path.endswith("site-packages")} | {Path(__file__).parents[1]}
    for path in (path for home in homes for path in home.rglob("*") if path.suffix in (".py", ".pyc", ".so", ".yaml")):
        with contextlib.suppress(OSError), open(path, "rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def write_recordings(folder: Path) -> None:
    """Write a simulated recording of a drive with friction, and a copy that contains text."""
    lines, position, velocity = ["time,qpos,qvel,ctrl"], 0.0, 0.0
    for sample in range(SAMPLES):
        moment = sample * STEP
        command = 0.6 * math.sin(9.4 * moment) + 0.3 * math.sin(4.4 * moment)
        lines.append(f"{moment:.9g},{position:.9g},{velocity:.9g},{command:.9g}")
        gravity, friction = 0.2875 * math.sin(position), 0.1 * math.tanh(velocity / 0.01) + 0.05 * velocity
        velocity += STEP * (20 * (command - position) - velocity - gravity - friction) / 0.0444
        position += STEP * velocity
    (folder / "a.csv").write_text("\n".join(lines) + "\n")
    lines[100] = "0.099,abc,0,0"
    (folder / "text.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
