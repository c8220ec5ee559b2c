"""Timing, tables, result files and machine description for all benchmarks."""

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

# jax is imported inside functions: a process that only starts others stays small.


@dataclass(frozen=True)
class Timed:
    """Timing of a function that was called several times.

    Attributes:
        seconds: Median time of a call [s].
        calls: Number of calls in the median.
        answer: Result of the last call.
    """

    seconds: float
    calls: int
    answer: Any


def median_time(function: Callable[..., Any], *arguments: Any, calls: int = 7, enough: float = 20.0) -> Timed:
    """Return the median time of a call, until its result is ready.

    The first call warms up and does not count, unless it takes longer than `enough`.

    Args:
        function: Function to time; compiled beforehand or by the first call.
        arguments: Its arguments.
        calls: Number of calls that count.
        enough: Time [s]; a longer first call is the only one.
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
    """Compile a function for these arguments; return it with the time of tracing and compiling [s].

    Disables JAX's compilation cache for this process, to time a first run.

    Args:
        compiler: `jax.jit`, or a `compile` of this package, which adds its engine's options.
        function: Function to compile.
        arguments: Arguments of the shapes of later calls.
    """
    import jax

    jax.config.update("jax_enable_compilation_cache", False)
    began = time.perf_counter()
    compiled = compiler(function).lower(*arguments).compile()
    return compiled, time.perf_counter() - began


def peak_memory() -> float:
    """Return the peak resident memory of this process [MB]."""
    # Linux's ru_maxrss includes the parent's memory when it started this process; VmHWM does not.
    status = Path("/proc/self/status")
    own = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.exists() else None
    if own:
        return int(own[1]) / 1e3
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def describe_machine() -> dict[str, Any]:
    """Return the processor, platform, device and versions of this machine."""
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
    """Return a parser with the option `--out`.

    Args:
        name: The benchmark's name; its results go to `benchmarks/results/NAME.json` by default.
        description: The script's docstring.
    """
    parser = argparse.ArgumentParser(description=description)
    default = Path("benchmarks") / "results" / f"{name}.json"
    parser.add_argument("--out", type=Path, default=default, metavar="FILE", help=f"JSON file, {default} by default")
    return parser


def report(out: Path, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str], **settings: Any) -> None:
    """Print the rows as a table; write them with settings and machine to a JSON file.

    Args:
        out: The file; its folder is created.
        rows: One mapping per measurement, with text, numbers and None.
        columns: Heading of each key in the table, in order.
        settings: Further settings to write.
    """
    print_table(rows, columns)
    write_json(out, {"settings": settings, "rows": list(rows)})


def print_table(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str] | None = None) -> None:
    """Print rows with aligned columns.

    Args:
        rows: One mapping per line, with text, numbers and None.
        columns: Heading of each key shown, in order; by default all keys of all rows.
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
    """Write content and, under `machine`, a description of this machine.

    Args:
        out: The file; its folder is created.
        content: JSON-compatible values.
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
