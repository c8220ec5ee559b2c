"""`python -m frictionzoo.list`, see `frictionzoo.cli.list`."""

if __name__ == "__main__":
    from frictionzoo.cli.commands import main

    main("list")
