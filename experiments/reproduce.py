"""Runs an experiment, compares it with what its page says, and writes the page's table.

`python experiments/reproduce.py kovalev2026` does what `expected.yaml` in `experiments/kovalev2026` says: it runs the
commands, compares all their runs, checks the numbers, and puts the table between the marks in the folder's README.md.
"""

import argparse
import math
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from frictionzoo.compare import Comparison, write_comparison
from frictionzoo.output import write_atomically

EXPERIMENTS = Path(__file__).parent
MARKS = re.compile(r"(<!-- table: .* -->\n).*?(<!-- end of table -->)", re.S)


def read_expected(name: str) -> dict[str, Any]:
    """What `expected.yaml` of an experiment says.

    Args:
        name: The experiment's folder.
    """
    return yaml.safe_load((EXPERIMENTS / name / "expected.yaml").read_text())


def run(name: str, output: Path) -> Comparison:
    """Run the commands of an experiment and compare all their runs.

    Args:
        name: The experiment's folder.
        output: Where runs and comparison go.
    """
    folders = []
    for number, command in enumerate(read_expected(name)["commands"]):
        program, *arguments = shlex.split(command)
        if program != "python":
            raise SystemExit(f"{name}: {command}; expected a command of python")
        folders.append(output / str(number))
        option = "hydra.sweep.dir" if "-m" in arguments[2:] else "hydra.run.dir"
        environment = {**os.environ, "PYTHONPATH": str(EXPERIMENTS.parent)}
        subprocess.run([sys.executable, *arguments, f"{option}={folders[-1]}"], env=environment, check=True)
    return write_comparison(folders, output / "comparison")


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


def find_run(comparison: Comparison, label: str | None) -> dict[str, Any]:
    """The entry of a run.

    Args:
        comparison: Of the experiment's runs.
        label: The run's; None for the only one.
    """
    found = [entry for entry in comparison["runs"] if label in (None, entry["label"])]
    if len(found) != 1:
        raise SystemExit(f"{label}: {len(found)} runs, expected one of {[run['label'] for run in comparison['runs']]}")
    return found[0]


def look_up(entry: Mapping[str, Any], path: str) -> Any:
    """A value of a run's entry; `parameters.OWNER.NAME` is that parameter's value, or None where there is none.

    Args:
        entry: Of `comparison.json`.
        path: Keys, separated by dots; numbers count in lists.
    """
    if path.startswith("parameters."):
        _, owner, name = path.split(".")
        return next((p["value"] for p in entry["parameters"] if (p["owner"], p["name"]) == (owner, name)), None)
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


def main() -> int:
    """Entry point; the exit status is 1 where a number is not as expected."""
    names = sorted(path.parent.name for path in EXPERIMENTS.glob("*/expected.yaml"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("name", choices=names)
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="where runs go, multirun/NAME by default")
    options = parser.parse_args()
    output = (options.output or Path("multirun") / options.name).resolve()
    expected, comparison = read_expected(options.name), run(options.name, output)
    mistakes = list(check(comparison, expected["checks"]))
    if "table" in expected:
        write_table(options.name, tabulate(comparison, expected))
    print("\n".join(mistakes) or f"{options.name}: all {len(expected['checks'])} numbers are as expected")
    return 1 if mistakes else 0


if __name__ == "__main__":
    sys.exit(main())
