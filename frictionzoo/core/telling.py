"""What a user at a terminal is told while a command works."""

import sys


def tell(doing: str) -> None:
    """Say on the standard error what is being done now, at once; nothing where that is no terminal."""
    if sys.stderr.isatty():
        print(f"{doing} ...", file=sys.stderr, flush=True)
