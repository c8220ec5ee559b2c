"""Pages of plug-ins, written from docstrings: `python docs/write_plugins.py`."""

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import yaml
from equations import to_fences

from frictionzoo.core.config import CONF_DIR, list_choices
from frictionzoo.core.declared import section_of
from frictionzoo.core.registry import KINDS
from frictionzoo.models import FrictionModel, get_model
from frictionzoo.models.by_joint import ByJoint
from frictionzoo.models.network import NetworkModel
from frictionzoo.report.text import to_markdown

DOCS = Path(__file__).parent
HEAD = """# Plug-ins

<!-- Generated from docstrings by `make docs`; edit the docstrings. -->

A plug-in is a part of frictionzoo that an option selects by name. To list all plug-ins, with those of other packages:

```bash
python -m frictionzoo.list
python -m frictionzoo.list models methods
```

[How to add one](../CONTRIBUTING.md).
"""


def render_models(text: str) -> str:
    """Return the page of friction models with new table and sections; all other text stays.

    Args:
        text: The page, with a pair of comments around the table and around the sections.
    """
    for part, content in (("table", table_of_laws()), ("sections", "\n\n".join(map(describe, choices())))):
        pattern = rf"(<!-- {part} [^\n]*-->\n).*?(\n<!-- end of {part} -->)"
        text, count = re.subn(pattern, lambda match: f"{match[1]}\n{content}\n{match[2]}", text, flags=re.S)  # noqa: B023
        assert count == 1, part
    return text


def render_plugins() -> str:
    """Return the page of all kinds of plug-ins."""
    return "\n".join([HEAD, *(f"## {kind.noun.capitalize()}s\n\n{table_of(name)}" for name, kind in KINDS.items())])


def table_of(plural: str) -> str:
    """Return a table of frictionzoo's plug-ins of a kind.

    Args:
        plural: Key of `KINDS`.
    """
    kind = KINDS[plural]
    rows = [
        (f"`{found.name}`", f"`{kind.choice.format(**found._asdict())}`", found.summary)
        for found in sorted(kind.own().values())
    ]
    note = f"Entry points of other packages: group `{kind.group}`.\n"
    return f"{_tabulate(('name', 'option', 'description'), rows)}\n{note}"


def table_of_laws() -> str:
    """Return a table with one row per choice of `model=`."""
    rows = ((f"[`{name}`](#{name})", _summary(name), _parameters(_law(name))) for name in choices())
    return _tabulate(("`model=`", "friction", "parameters"), rows).rstrip()


def choices() -> list[str]:
    """Return every choice of `model=`: friction models, and configurations that choose more than a model."""
    return list_choices("model")


def describe(name: str) -> str:
    """Describe a choice of `model=` by the docstring of its model, or by the head comment of its configuration."""
    text = to_markdown(_law(name).__doc__ or "", typeset=to_fences) if _is_law(name) else _header(name)
    return f"## `{name}`\n\n{text}\n\n{_options(name)}"


def _options(name: str) -> str:
    """Return a table of a model's options with their defaults, or a link to its file."""
    if (CONF_DIR / "model" / f"{name}.yaml").exists():
        return f"Options: [`conf/model/{name}.yaml`](../conf/model/{name}.yaml)"
    section = section_of(_law(name))
    params = section.pop("params", {}).items()
    rows = [(f"`model.{option}`", f"`{value}`", "", "") for option, value in section.items() if option != "_target_"]
    for parameter, entries in params:
        start, low, high = (
            _plain(entries[key]) for key in ("default" if "default" in entries else "init", "low", "high")
        )
        notes = ["the robot's file has precedence"] if "default" in entries else []
        notes += [] if entries["identify"] else ["fixed"]
        rows.append((f"`model.params.{parameter}`", start, f"{low.partition(' ')[0]} to {high}", ", ".join(notes)))
    return _tabulate(("option", "initial value", "bounds", ""), rows).rstrip() if rows else "No options."


def _plain(value: str | float) -> str:
    """Return a value of a configuration without its references: `3 / velocity` for a quotient."""
    text = re.sub(r"\$\{scale\.(\w+)\}", r"\1", f"{value:g}" if isinstance(value, float) else str(value))
    for _ in range(3):  # innermost first
        text = re.sub(r"\$\{mul:(velocity),velocity\}", r"\1^2", text)
        text = re.sub(r"\$\{mul:([^{},]*),([^{},]*)\}", r"\1 \2", text)
        text = re.sub(r"\$\{div:([^{},]*),([^{},]*)\}", r"\1 / \2", text)
    return re.sub(r"(?<=\d)\.0\b", "", text)


def _is_law(name: str) -> bool:
    return name in KINDS["models"].own()


def _law(name: str) -> type[FrictionModel]:
    """Return the class of a choice; a configuration without a class starts from another configuration."""
    if _is_law(name):
        return get_model(name)
    first = yaml.safe_load((CONF_DIR / "model" / f"{name}.yaml").read_text())["defaults"][0]
    return _law(first.partition("@")[0])


def _summary(name: str) -> str:
    text = (_law(name).__doc__ or "").partition("\n")[0] if _is_law(name) else _header(name).partition("\n")[0]
    return text.rstrip(".")


def _header(name: str) -> str:
    """Return the head comment of a file in `conf/model`."""
    lines = (CONF_DIR / "model" / f"{name}.yaml").read_text().splitlines()
    comments = lines[: next(i for i, line in enumerate(lines) if not line.startswith("#"))]
    return "\n".join(line.removeprefix("# ") for line in comments if not line.startswith("# @package"))


def _parameters(law: type[FrictionModel]) -> str:
    if law is ByJoint:
        return "those of its models"
    weights = ["weights"] if issubclass(law, NetworkModel) else []
    return ", ".join([*(f"`{name}`" for name in law.dimensions), *weights]) or "none"


def _tabulate(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    first, *others = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in (head, *rows))
    return "\n".join([f"| {first} |", f"|{len(head) * '---|'}", *(f"| {row} |" for row in others)]) + "\n"


PAGES: dict[str, Callable[[str], str]] = {"models": render_models, "plugins": lambda text: render_plugins()}

if __name__ == "__main__":
    for page, render in PAGES.items():
        path = DOCS / f"{page}.md"
        path.write_text(render(path.read_text() if path.exists() else ""))
