"""`python -m frictionzoo.compare`, see `frictionzoo.cli.compare`."""

if __name__ == "__main__":
    import sys

    from frictionzoo.cli.compare import main

    sys.exit(main())
