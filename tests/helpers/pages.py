"""The pages of the documentation in the repository, and the commands that they tell a reader to type."""

import re
from collections.abc import Iterator
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser

from frictionzoo.core.config import list_choices

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "tutorials").glob("*.md")),
    *sorted((ROOT / "experiments").glob("*/README.md")),
    ROOT / "benchmarks" / "README.md",
]
PACKAGE = ROOT / "experiments" / "out_of_tree"  # tests/test_out_of_tree.py installs it and runs its page's commands
PROGRAMS = "python|frictionzoo|pip|make|pytest|pre-commit|tensorboard|wandb|mlflow|mkdocs|bash"


def blocks_of(page: Path) -> list[str]:
    return [block.strip() for block in re.findall(r"^```bash\n(.*?)^```$", page.read_text(), re.M | re.S)]


def inline_of(page: Path) -> list[str]:
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
    return re.findall(r"(?<!`)`(?!`)([^`]+)`(?!`)", text)


def commands_of(page: Path) -> Iterator[str]:
    """Every line of every bash block, and inline code that starts with a program and says more than its name."""
    for block in blocks_of(page):
        yield from (line for line in block.splitlines() if line)
    for code in inline_of(page):
        if re.match(rf"({PROGRAMS}) ", code):
            yield " ".join(code.split())


def expand(argument: str) -> list[str]:
    """One override for each value of a sweep."""
    override = OverridesParser.create().parse_override(argument)
    if "glob(" in argument:
        return [f"{override.key_or_group}={name}" for name in list_choices(override.key_or_group)]
    if override.is_interval_sweep():
        interval = override.value()
        return [f"{override.key_or_group}={value}" for value in (interval.start, interval.end)]
    if override.is_sweep_override():
        return [f"{override.key_or_group}={value}" for value in override.sweep_string_iterator()]
    return [argument]
