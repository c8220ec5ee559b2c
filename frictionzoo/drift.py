"""`python -m frictionzoo.drift`, see `frictionzoo.cli.finished`."""

if __name__ == "__main__":
    from frictionzoo.cli.commands import main

    main("drift")
