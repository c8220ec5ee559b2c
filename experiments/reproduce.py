"""Runs an experiment, compares it with what its page says, and writes the page's table.

`python experiments/reproduce.py kovalev2026` does what `expected.yaml` in `experiments/kovalev2026` says: it runs the
commands, compares all their runs, checks the numbers, and puts the table between the marks in the folder's README.md.
Several names run one after the other, and none stands for all. With `--small` they are what the section `small` says
instead, as the slow tests do it: seconds on less data, with numbers of its own, and the page stays as it is.
"""

import argparse
import math
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from frictionzoo.cli.run import NOT_IDENTIFIED
from frictionzoo.comparison.files import write_comparison
from frictionzoo.comparison.record import compare_runs
from frictionzoo.comparison.runs import read_runs
from frictionzoo.comparison.types import Comparison, RunRow
from frictionzoo.core.output import write_atomically

EXPERIMENTS = Path(__file__).parent
PROGRAM = "python -m frictionzoo.run "
MARKS = re.compile(r"(<!-- table: .* -->\n).*?(<!-- end of table -->)", re.S)


def read_expected(name: str, small: bool = False) -> dict[str, Any]:
    """What `expected.yaml` of an experiment says.

    Args:
        name: The experiment's folder.
        small: Take what its section `small` has, if there is one, for what stands outside under the same name.
    """
    expected = yaml.safe_load((EXPERIMENTS / name / "expected.yaml").read_text())
    return expected | expected.get("small", {}) if small else expected


def start(*arguments: str) -> None:
    """Run `python -m frictionzoo.run` as a process of its own, and raise if it fails.

    A fit that did not identify its drive does not fail: what it found is judged by the checks.

    Args:
        arguments: Its command line.

    Raises:
        CalledProcessError: It fails.
    """
    environment = {**os.environ, "PYTHONPATH": str(EXPERIMENTS.parent)}
    finished = subprocess.run([sys.executable, *shlex.split(PROGRAM)[1:], *arguments], env=environment)
    if finished.returncode not in (0, NOT_IDENTIFIED):
        finished.check_returncode()


def run(commands: list[str], output: Path, start: Callable[..., Any] = start) -> list[Path]:
    """Run the commands of an experiment.

    Args:
        commands: As in `expected.yaml`.
        output: Where runs go.
        start: Does what `python -m frictionzoo.run` does with these arguments.

    Returns:
        The folder of each command's runs.
    """
    folders = [output / str(number) for number in range(len(commands))]
    for command, folder in zip(commands, folders, strict=True):
        if not command.startswith(PROGRAM):
            raise SystemExit(f"{command}; expected a command that begins with {PROGRAM}")
        arguments = shlex.split(command.removeprefix(PROGRAM))
        start(*arguments, f"hydra.{'sweep' if '-m' in arguments else 'run'}.dir={folder}")
    return folders


def check(comparison: Comparison, checks: list[dict[str, Any]]) -> Iterator[str]:
    """One line for each number that is not as expected.

    Args:
        comparison: Of the experiment's runs.
        checks: `run` (may be left out where there is one), `path` in its entry, and `expected` with `relative`, or
            `at_most`.
    """
    for expected in checks:
        entry = find_run(comparison, expected.get("run"))
        value = look_up(entry, expected["path"])
        if not agrees(value, expected):
            yield f"{entry['label']}: {expected['path']} is {value}, expected {expected}"


def find_run(comparison: Comparison, label: str | None) -> RunRow:
    """The entry of a run.

    Args:
        comparison: Of the experiment's runs.
        label: The run's; None for the only one.
    """
    found = [entry for entry in comparison["runs"] if label in (None, entry["label"])]
    if len(found) != 1:
        raise SystemExit(f"{label}: {len(found)} runs, expected one of {[run['label'] for run in comparison['runs']]}")
    return found[0]


def look_up(entry: Mapping[str, object], path: str) -> Any:
    """A value of a run's entry; `parameters.OWNER.NAME` is that parameter's value, or None where there is none.

    Of several joints, `parameters.OWNER.NAME.2` is that of the third.

    Args:
        entry: Of `comparison.json`.
        path: Keys, separated by dots; numbers count in lists.
    """
    if path.startswith("parameters."):
        _, owner, name, *joint = path.split(".")
        value = next((p["value"] for p in entry["parameters"] if (p["owner"], p["name"]) == (owner, name)), None)
        return value[int(joint[0])] if joint and value is not None else value
    value: Any = entry
    for key in path.split("."):
        value = value[int(key)] if isinstance(value, list) else value[key]
    return value


def agrees(value: float | None, expected: Mapping[str, float]) -> bool:
    """Whether a value is what a check expects.

    Args:
        value: None is never what is expected.
        expected: `at_most`, or `expected` with the `relative` difference that is allowed.
    """
    if value is None:
        return False
    if "at_most" in expected:
        return value <= expected["at_most"]
    return math.isclose(value, expected["expected"], rel_tol=expected["relative"], abs_tol=0.0)


def tabulate(comparison: Comparison, expected: Mapping[str, Any]) -> str:
    """The experiment's table in Markdown, a row a run.

    Args:
        comparison: Of the experiment's runs.
        expected: With `table`, a list of columns: `head`, and `values` (paths in a run's entry, multiplied by `scale`)
            put into `format`; or `published`, the name of a mapping from label to text.
    """
    columns = expected["table"]
    rows = [[_cell(entry, column, expected) for column in columns] for entry in comparison["runs"]]
    lines = [[column["head"] for column in columns], ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _cell(entry: Mapping[str, Any], column: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    if "published" in column:
        return expected[column["published"]].get(entry["label"], "")
    values = [look_up(entry, path) for path in column["values"]]
    if None in values:
        return ""
    scale = column.get("scale")
    return column["format"].format(*(values if scale is None else [scale * value for value in values]))


def write_table(name: str, table: str) -> None:
    """Put a table between the marks of the experiment's page.

    Args:
        name: The experiment's folder.
        table: In Markdown.
    """
    page = EXPERIMENTS / name / "README.md"
    text, count = MARKS.subn(lambda found: f"{found[1]}{table}\n{found[2]}", page.read_text())
    if count != 1:
        raise SystemExit(f"{page}: {count} places for a table, expected one between <!-- table: ... --> marks")
    write_atomically(page, text.encode())


def reproduce(name: str, output: Path, small: bool) -> list[str]:
    """Run an experiment and write its table; returns one line for each number that is not as expected.

    Args:
        name: The experiment's folder.
        output: Where runs and comparison go.
        small: Run its small variant, and leave the table.
    """
    expected = read_expected(name, small)
    try:
        folders = run(expected["commands"], output)
    except subprocess.CalledProcessError as error:
        return [f"{name}: {shlex.join(error.cmd)} ended with status {error.returncode}"]
    comparison = compare_runs(*read_runs(folders)) if small else write_comparison(folders, output / "comparison")
    if "table" in expected and not small:
        write_table(name, tabulate(comparison, expected))
    return [f"{name}: {line}" for line in check(comparison, expected["checks"])]


def main() -> int:
    """Entry point; the exit status is 1 where a number is not as expected."""
    names = sorted(path.parent.name for path in EXPERIMENTS.glob("*/expected.yaml"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(names)}; all by default")
    parser.add_argument("--small", action="store_true", help="the small variant, which leaves the table as it is")
    parser.add_argument("--output", type=Path, metavar="FOLDER", default=Path("multirun"), help="where runs go")
    options = parser.parse_args()
    if unknown := set(options.names) - set(names):
        parser.error(f"{min(unknown)}: no such experiment; expected one of {', '.join(names)}")
    mistakes = []
    for name in options.names or names:
        found = reproduce(name, (options.output / name).resolve(), options.small)
        print("\n".join(found) or f"{name}: all numbers are as expected", flush=True)
        mistakes += found
    return 1 if mistakes else 0


if __name__ == "__main__":
    sys.exit(main())
