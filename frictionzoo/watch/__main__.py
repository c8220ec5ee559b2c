"""Entry point of `python -m frictionzoo.watch`, see `frictionzoo.cli.watch`."""

from frictionzoo.cli.commands import main

main("watch")
