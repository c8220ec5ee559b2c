"""`python -m frictionzoo.run`, see `frictionzoo.cli.run`."""

# What processes that launchers start have to import must not lie in __main__.
if __name__ == "__main__":
    from frictionzoo.cli.commands import main

    main("run")
