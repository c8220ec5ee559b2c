"""Entry point of `python -m frictionzoo.inspect`, see `frictionzoo.cli.inspect`."""

from frictionzoo.cli.commands import main

main("inspect")
