"""`python -m frictionzoo.design`, see `frictionzoo.cli.finished`."""

from frictionzoo.cli.commands import main

main("design")
