"""`python -m frictionzoo.distill`, see `frictionzoo.cli.distill`."""

from frictionzoo.cli.commands import main

main("distill")
