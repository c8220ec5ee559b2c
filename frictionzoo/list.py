"""`python -m frictionzoo.list`, see `frictionzoo.cli.list`."""

if __name__ == "__main__":
    import sys

    from frictionzoo.cli.list import main

    sys.exit(main())
