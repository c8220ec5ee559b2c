"""Page of the configuration: every file of conf/, every option with its value and comment."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

HEAD = """# Configuration

Every option of the command line, made from the files in `conf/`. A group's file is chosen as `GROUP=FILE`, an option is
set as `OPTION=VALUE`; `python -m frictionzoo.run --cfg job` shows all values of a job. The options of a friction model
are in [its section](models.md). `${...}` takes a value from elsewhere: `${scale.torque}` is the option `scale.torque`,
`${mul:a,b}` a product, `${div:a,b}` a quotient.
"""
PACKAGE = re.compile(r"# @package (\S+)")
COMMAND = re.compile(r"^ *(python -m frictionzoo\.run .*)$")
SPECIAL = re.compile(r"([*<|\[\]])")


class Row(NamedTuple):
    """One option: command-line name, value as written, and comment."""

    option: str
    value: str
    comment: str


def render(folder: Path) -> str:
    """Return the page as Markdown.

    Args:
        folder: Folder of the configuration, with one subfolder per group.
    """
    groups: dict[str, list[Path]] = {}
    for path in sorted(folder.rglob("*.yaml"), key=lambda path: (len(path.relative_to(folder).parts) > 1, path)):
        groups.setdefault(path.relative_to(folder).parent.as_posix(), []).append(path)
    sections = [text for group, paths in groups.items() for text in _render_group(group, paths)]
    return "\n".join([HEAD, *sections])


def read_rows(path: Path, group: str) -> list[Row]:
    """Return the options of a file.

    Args:
        path: The file.
        group: Folder of the file below conf/; "." for conf/ itself.
    """
    text = path.read_text()
    package = PACKAGE.search(text)
    prefix = package[1] if package else group.replace("/", ".")
    node = yaml.compose(text)
    return list(_rows("" if prefix in ("_global_", ".") else f"{prefix}.", node, text.splitlines()))


def _render_group(group: str, paths: Sequence[Path]) -> Iterator[str]:
    if group != ".":
        yield f"## `{group}`\n"
    for path in paths:
        yield f"### `{group}={path.stem}`\n" if group != "." else f"## `{path.name}`\n"
        yield _describe(path.read_text()) + "\n"
        rows = read_rows(path, group)
        yield "| option | value | |\n|---|---|---|\n" + "\n".join(map(_render_row, rows)) + "\n"


def _describe(text: str) -> str:
    """Return the comment at the head of a file, with commands as code."""
    lines = text[: re.match(r"(#.*\n)*", text).end()].splitlines()
    said = [line.removeprefix("#").strip() for line in lines if not PACKAGE.match(line)]
    return "\n".join(COMMAND.sub(r"`\1`  ", line) if COMMAND.match(line) else _escape(line) for line in said)


def _render_row(row: Row) -> str:
    value = f"`{row.value}`".replace("|", "\\|") if row.value else ""
    return f"| `{row.option}` | {value} | {_escape(row.comment)} |"


def _rows(prefix: str, node: yaml.Node, lines: Sequence[str]) -> Iterator[Row]:
    """Yield the options of a mapping, in order; a section with a comment has a row, too."""
    for key, value in node.value:
        if key.value == "defaults":
            yield from _choices(value, lines)
            continue
        comment = _comment(key, value, lines)
        if isinstance(value, yaml.MappingNode):
            if comment:
                yield Row(f"{prefix}{key.value}", "", comment)
            yield from _rows(f"{prefix}{key.value}.", value, lines)
        else:
            yield Row(f"{prefix}{key.value}", _source(value, lines), comment)


def _choices(node: yaml.Node, lines: Sequence[str]) -> Iterator[Row]:
    """Yield the entries of a defaults list: the default file of each group."""
    for item in node.value:
        if isinstance(item, yaml.MappingNode):
            ((key, value),) = item.value
            yield Row(re.sub(r"^(override|optional) +/?", "", key.value), value.value, _comment(key, value, lines))
        elif item.value != "_self_":
            name, _, group = item.value.partition("@")
            yield Row(group, f"as {name}", "")


def _source(node: yaml.Node, lines: Sequence[str]) -> str:
    """Return a value as written, on one line."""
    start, end = node.start_mark, node.end_mark
    if end.line == start.line:
        return lines[start.line][start.column : end.column]
    return " ".join(line.strip() for line in [lines[start.line][start.column :], *lines[start.line + 1 : end.line]])


def _comment(key: yaml.Node, value: yaml.Node, lines: Sequence[str]) -> str:
    """Return the comments above a key and after its value, or after the key if the value begins on the next line."""
    first, column = key.start_mark.line, key.start_mark.column
    above = first
    while not lines[first][:column].strip() and above > 0 and lines[above - 1].strip().startswith("#"):
        above -= 1
    said = [line.strip().removeprefix("#").strip() for line in lines[above:first]] if above else []
    end = value.end_mark if value.end_mark.line == first else key.end_mark
    behind = re.match(r":?\s*#(.*)", lines[first][end.column :])
    return " ".join([*said, behind[1].strip() if behind else ""]).strip()


def _escape(text: str) -> str:
    """Escape a text so that Markdown formats only its code."""
    parts = re.split(r"(`[^`]*`)", text)
    parts[::2] = [SPECIAL.sub(r"\\\1", part) for part in parts[::2]]
    return "".join(parts)
