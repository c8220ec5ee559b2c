"""`python -m frictionzoo.export`, see `frictionzoo.cli.finished`."""

from frictionzoo.cli.commands import main

main("export")
