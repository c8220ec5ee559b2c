"""Reproduction of experiments: runs, checks against the expected numbers, and tables of the pages.

`python experiments/reproduce.py kovalev2026` follows `expected.yaml` in `experiments/kovalev2026`: it runs the
commands, compares all runs, checks the numbers, and writes the table between the marks in the folder's README.md. With
`folds`, each command runs once per fold with the fold's options, and runs of the same fold are compared. Several names
run one after another; no name means all. `--small` takes the section `small` instead, as the slow tests do: it runs
seconds on less data, checks separate numbers, and does not write the page.
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

from frictionzoo.api.comparison_files import write_comparison
from frictionzoo.cli.run import NOT_IDENTIFIED
from frictionzoo.core.output import to_json
from frictionzoo.result.comparison.record import compare_runs
from frictionzoo.result.comparison.runs import read_runs

EXPERIMENTS = Path(__file__).parent
PROGRAM = "python -m frictionzoo.run "
MARKS = re.compile(r"(<!-- table: .* -->\n).*?(<!-- end of table -->)", re.S)


def read_expected(name: str, small: bool = False) -> dict[str, Any]:
    """Return the content of an experiment's `expected.yaml`.

    Args:
        name: The experiment's folder.
        small: Replace keys by the keys of the section `small`, if there is one.
    """
    expected = yaml.safe_load((EXPERIMENTS / name / "expected.yaml").read_text())
    return expected | expected.get("small", {}) if small else expected


def start(*arguments: str) -> None:
    """Run `python -m frictionzoo.run` in a separate process.

    A fit that did not identify its drive is not a failure: the checks judge its result.

    Args:
        arguments: Command-line arguments.

    Raises:
        CalledProcessError: The run failed.
    """
    environment = {**os.environ, "PYTHONPATH": str(EXPERIMENTS.parent)}
    finished = subprocess.run([sys.executable, *shlex.split(PROGRAM)[1:], *arguments], env=environment)
    if finished.returncode not in (0, NOT_IDENTIFIED):
        finished.check_returncode()


def run(commands: list[str], output: Path, start: Callable[..., Any] = start) -> list[Path]:
    """Run the commands of an experiment.

    Args:
        commands: Commands as in `expected.yaml`.
        output: Folder for the runs.
        start: Function that runs `python -m frictionzoo.run` with its arguments.

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


def check(comparison: Mapping[str, Any], checks: list[dict[str, Any]]) -> Iterator[str]:
    """Yield one line for each number that is not as expected.

    Args:
        comparison: Comparison of the experiment's runs.
        checks: Each has `run` (optional for a single run), `path` in the run's entry, and either `expected` with
            `relative`, or `at_most`. With `of`, the label of another run, the value is first divided by the value of
            that run. A check applies to every fold, or to `fold`.
    """
    folds = list(dict.fromkeys(entry.get("fold") for entry in comparison["runs"]))
    for expected in checks:
        for fold in [expected["fold"]] if "fold" in expected else folds:
            entry, path = find_run(comparison, expected.get("run"), fold), expected["path"]
            value = look_up(entry, path)
            if "of" in expected:
                value = compare_with(value, look_up(find_run(comparison, expected["of"], fold), path))
            if not all(agrees(one, expected) for one in (value if isinstance(value, list) else [value])):
                where = entry["label"] if fold is None else f"{entry['label']}, {fold}"
                yield f"{where}: {path} is {value}, expected {expected}"


def compare_with(value: Any, other: Any) -> Any:
    """Return values as shares of another run's values; None where a value is None or the other value is 0 or None.

    Args:
        value: A number or a list of numbers.
        other: The other run's number or list.
    """
    if isinstance(value, list):
        return [compare_with(*pair) for pair in zip(value, other, strict=True)]
    return None if value is None or not other else value / other


def find_run(comparison: Mapping[str, Any], label: str | None, fold: str | None = None) -> dict[str, Any]:
    """Return the entry of a run.

    Args:
        comparison: Comparison of the experiment's runs.
        label: Label of the run; None for the only run.
        fold: Label of the fold; None without folds.
    """
    found = [e for e in comparison["runs"] if label in (None, e["label"]) and e.get("fold") == fold]
    if len(found) != 1:
        raise SystemExit(f"{label}: {len(found)} runs, expected one of {[run['label'] for run in comparison['runs']]}")
    return found[0]


def look_up(entry: Mapping[str, Any], path: str) -> Any:
    """Return a value of a run's entry.

    `parameters.OWNER.NAME` is a parameter's value, or None if the run lacks it. With several joints,
    `parameters.OWNER.NAME.2` is the value of the third joint. The key `*` gives a list with a value per list entry.

    Args:
        entry: Entry of a run in `comparison.json`.
        path: Keys separated by dots; numbers index lists.
    """
    if path.startswith("parameters."):
        _, owner, name, *joint = path.split(".")
        value = next((p["value"] for p in entry["parameters"] if (p["owner"], p["name"]) == (owner, name)), None)
        return value[int(joint[0])] if joint and value is not None else value
    value: Any = entry
    key, _, rest = path.partition(".")
    if key == "*":
        return [look_up(each, rest) if rest else each for each in value]
    value = value[int(key)] if isinstance(value, list) else value[key]
    return look_up(value, rest) if rest else value


def agrees(value: float | None, expected: Mapping[str, float]) -> bool:
    """Return whether a value meets a check.

    Args:
        value: The value; None never meets a check.
        expected: `at_most`, or `expected` with the allowed `relative` difference.
    """
    if value is None:
        return False
    if "at_most" in expected:
        return value <= expected["at_most"]
    return math.isclose(value, expected["expected"], rel_tol=expected["relative"], abs_tol=0.0)


def tabulate(comparison: Any, expected: Mapping[str, Any]) -> str:
    """Return the experiment's table in Markdown, one row per run.

    Args:
        comparison: Comparison of the experiment's runs.
        expected: Its `table` is a list of columns with `head` and either `values` or `published`. `values` are paths in
            a run's entry; their values, multiplied by `scale`, fill `format`. A single path with `*` fills `format`
            once per value, without `scale`. `published` is the name of a mapping from label to text.
    """
    columns = expected["table"]
    rows = [[_cell(entry, column, expected) for column in columns] for entry in comparison["runs"]]
    lines = [[column["head"] for column in columns], ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _cell(entry: Mapping[str, Any], column: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    if "published" in column:
        return expected[column["published"]].get(entry["label"], "")
    values = [look_up(entry, path) for path in column["values"]]
    if "*" in column["values"][0].split("."):
        return ", ".join(column["format"].format(value) for value in values[0])
    if None in values:
        return ""
    scale = column.get("scale")
    return column["format"].format(*(values if scale is None else [scale * value for value in values]))


def write_table(name: str, table: str) -> None:
    """Put a table between the marks of the experiment's page.

    Args:
        name: The experiment's folder.
        table: The table in Markdown.
    """
    page = EXPERIMENTS / name / "README.md"
    text, count = MARKS.subn(lambda found: f"{found[1]}{table}\n{found[2]}", page.read_text())
    if count != 1:
        raise SystemExit(f"{page}: {count} places for a table, expected one between <!-- table: ... --> marks")
    page.write_text(text, encoding="utf-8")


def compare(
    expected: Mapping[str, Any], output: Path, small: bool, start: Callable[..., Any] = start
) -> dict[str, Any]:
    """Run an experiment and return its comparison as JSON; with folds, compare within each fold and sort by label.

    Args:
        expected: Content of `expected.yaml`.
        output: Folder for runs and comparisons.
        small: Write no comparison.
        start: As in `run`.

    Raises:
        CalledProcessError: A run failed.
    """
    if "folds" in expected:
        entries = []
        for number, (fold, options) in enumerate(expected["folds"].items()):
            commands = [" ".join([command, *options]) for command in expected["commands"]]
            found = compare({"commands": commands}, output / str(number), small, start)
            entries += sorted(({**entry, "fold": fold} for entry in found["runs"]), key=lambda entry: entry["label"])
        return {"runs": entries}
    folders = run(expected["commands"], output, start)
    compared = compare_runs(*read_runs(folders)) if small else write_comparison(folders, output / "comparison")
    return to_json(compared)


def reproduce(name: str, output: Path, small: bool) -> list[str]:
    """Run an experiment and write its table; return one line for each number that is not as expected.

    Args:
        name: The experiment's folder.
        output: Folder for runs and comparison.
        small: Run the small variant and write no table.
    """
    expected = read_expected(name, small)
    try:
        comparison = compare(expected, output, small)
    except subprocess.CalledProcessError as error:
        return [f"{name}: {shlex.join(error.cmd)} ended with status {error.returncode}"]
    if "table" in expected and not small:
        write_table(name, tabulate(comparison, expected))
    return [f"{name}: {line}" for line in check(comparison, expected["checks"])]


def main() -> int:
    """Reproduce experiments; return 1 if a number is not as expected."""
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
