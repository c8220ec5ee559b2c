"""Command line: `python -m frictionzoo.list [KIND...]` lists plug-ins, including those of other packages."""

import argparse
from collections.abc import Sequence

from frictionzoo.cli.mistakes import fail
from frictionzoo.core.errors import ConfigError, FrictionzooError, closest
from frictionzoo.core.registry import KINDS, Kind
from frictionzoo.core.telling import Parser, say


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; `arguments` default to `sys.argv`. A user's mistake ends it with one line and status 2."""
    names = _parse(arguments).kinds
    try:
        for name in names:
            if name not in KINDS:
                raise ConfigError(f"{name}: no such kind of plug-ins; {closest(name, KINDS)}")
        # This imports no plug-in.
        say("\n\n".join(list_kind(KINDS[name]) for name in names or KINDS))
    except FrictionzooError as error:
        fail(str(error))


def list_kind(kind: Kind) -> str:
    """Return the plug-ins of a kind, one per line: name, package, option, first line of its docstring."""
    rows = [
        (plugin.name, plugin.package, kind.choice.format(**plugin._asdict()), plugin.summary)
        for plugin in kind.list_all()
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)] if rows else []
    lines = ("  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n  ".join([f"{kind.plural} (entry-point group {kind.group})", *lines])


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="python -m frictionzoo.list",
        description="List the plug-ins of frictionzoo and of other installed packages: name, package, option and "
        "description.",
    )
    parser.add_argument("kinds", metavar="KIND", nargs="*", help=f"{', '.join(KINDS)}; default: all")
    return parser.parse_args(arguments)
