"""`python -m frictionzoo.design`, see `frictionzoo.cli.design`."""

from frictionzoo.cli.commands import main

main("design")
