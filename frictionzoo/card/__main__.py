"""Entry point of `python -m frictionzoo.card`, see `frictionzoo.cli.card`."""

from frictionzoo.cli.commands import main

main("card")
