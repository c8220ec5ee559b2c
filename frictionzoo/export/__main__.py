"""`python -m frictionzoo.export`, see `frictionzoo.cli.export`."""

from frictionzoo.cli.commands import main

main("export")
