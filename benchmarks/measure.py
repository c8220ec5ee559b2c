"""What the benchmarks share: how a time is taken, how results are shown and kept, and what they ran on."""

import argparse
import json
import os
import platform
import re
import resource
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("frictionzoo", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "scipy", "optax", "torch")

# jax is imported where it is needed: a process that only starts others stays small.


@dataclass(frozen=True)
class Timed:
    """A function that was called several times.

    Attributes:
        seconds: Median time of a call [s].
        calls: Calls that the median is of.
        answer: What the last call gave.
    """

    seconds: float
    calls: int
    answer: Any


def median_time(function: Callable[..., Any], *arguments: Any, calls: int = 7, enough: float = 20.0) -> Timed:
    """Median time of a call, until its answer is there.

    The first call warms up and is not counted, unless it takes so long that it has to do for all.

    Args:
        function: What is timed; compiled beforehand, or the first call compiles it.
        arguments: Its arguments.
        calls: Calls that count.
        enough: A first call that takes longer [s] is the only one.
    """
    first, answer = _call(function, arguments)
    if first > enough:
        return Timed(first, 1, answer)
    times = []
    for _ in range(calls):
        seconds, answer = _call(function, arguments)
        times.append(seconds)
    return Timed(statistics.median(times), calls, answer)


def compile_time(compiler: Callable[..., Any], function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """A function compiled for these arguments, and the time that tracing and compiling it took [s].

    JAX's cache of compiled functions is switched off for this process, so that the time is that of a first run.

    Args:
        compiler: `jax.jit`, or a `compile` of this package, which brings its engine's options.
        function: What is compiled.
        arguments: Arguments of the shapes that it will be called with.
    """
    import jax

    jax.config.update("jax_enable_compilation_cache", False)
    began = time.perf_counter()
    compiled = compiler(function).lower(*arguments).compile()
    return compiled, time.perf_counter() - began


def peak_memory() -> float:
    """Largest resident memory that this process has had so far [MB]."""
    # Linux's ru_maxrss is never below what the parent had when it started this process; VmHWM is this program's own.
    status = Path("/proc/self/status")
    own = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.exists() else None
    if own:
        return int(own[1]) / 1e3
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def describe_machine() -> dict[str, Any]:
    """What a benchmark ran on: processor, platform, device, versions."""
    import jax

    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
    }


def make_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """A parser that knows `--out`.

    Args:
        name: The benchmark's name; its results go to `benchmarks/results/NAME.json` by default.
        description: The script's docstring.
    """
    parser = argparse.ArgumentParser(description=description)
    default = Path("benchmarks") / "results" / f"{name}.json"
    parser.add_argument("--out", type=Path, default=default, metavar="FILE", help=f"JSON file, {default} by default")
    return parser


def report(out: Path, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str], **settings: Any) -> None:
    """Print the rows as a table, and write them with settings and machine into a JSON file.

    Args:
        out: The file; its folder is made.
        rows: One mapping a measurement, of text, numbers and None.
        columns: Heading of each key that the table shows, in order.
        settings: What else a reader of the file should know.
    """
    print_table(rows, columns)
    write_json(out, {"settings": settings, "rows": list(rows)})


def print_table(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str] | None = None) -> None:
    """Print rows with aligned columns.

    Args:
        rows: One mapping a line, of text, numbers and None.
        columns: Heading of each key that is shown, in order; by default all keys of all rows.
    """
    columns = columns or {key: key for row in rows for key in row}
    cells = [list(columns.values()), *([_cell(row.get(key)) for key in columns] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    numeric = [not any(isinstance(row.get(key), str) for row in rows) for key in columns]
    for line in cells:
        aligned = [
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(line, widths, numeric, strict=True)
        ]
        print("  ".join(aligned).rstrip())


def write_json(out: Path | str, content: Mapping[str, Any]) -> None:
    """Write content and, under `machine`, what it was measured on.

    Args:
        out: The file; its folder is made.
        content: What JSON can hold.
    """
    path = Path(out)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"machine": describe_machine(), **content}, indent=2) + "\n")


def _call(function: Callable[..., Any], arguments: Sequence[Any]) -> tuple[float, Any]:
    import jax

    began = time.perf_counter()
    answer = jax.block_until_ready(function(*arguments))
    return time.perf_counter() - began, answer


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    name = re.search(r"model name\s*: (.*)", information.read_text()) if information.exists() else None
    return name[1] if name else platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
