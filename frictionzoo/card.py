"""`python -m frictionzoo.card`, see `frictionzoo.cli.card`."""

if __name__ == "__main__":
    from frictionzoo.cli.commands import main

    main("card")
