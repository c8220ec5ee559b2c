"""`python -m frictionzoo.inspect`, see `frictionzoo.cli.inspect`."""

if __name__ == "__main__":
    from frictionzoo.cli.commands import main

    main("inspect")
