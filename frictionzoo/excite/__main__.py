"""`python -m frictionzoo.excite`, see `frictionzoo.cli.excite`."""

from frictionzoo.cli.commands import main

main("excite")
